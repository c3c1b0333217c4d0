"""``python -m isp_assets_plugins.usd FILE...``: print what is wrong with USD files; exit 1 if anything is."""

import sys
from pathlib import Path

from .check import check_usd

if __name__ == "__main__":
    findings = [f"{file}: {finding}" for file in sys.argv[1:] for finding in check_usd(Path(file))]
    print("\n".join(findings) or "no findings")
    sys.exit(int(bool(findings)))
