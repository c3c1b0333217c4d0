"""The writer plugins that ship with isp-assets, one small package each."""
