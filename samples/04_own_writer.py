"""04: a writer plugin of one's own, found without installing it. Run: python samples/04_own_writer.py

The plugin is the template in ``writer_plugin_template``; its README is a tutorial.
"""

import os
import tempfile
from pathlib import Path

from isp_assets import find_writers, make_writer
from isp_assets.plugin_conformance import check_writer, write_shot
from isp_assets.synthetic import synthetic_shot

os.environ["ISP_ASSETS_PLUGIN_PATH"] = str(Path(__file__).parent / "writer_plugin_template")
found = find_writers()["bounds"]
print(f"found {found.name} {found.version} in {found.origin}")

folder = Path(tempfile.mkdtemp())
check_writer(found.writer, folder / "conformance")  # what a plugin's own tests should run

path = folder / "shot.csv"
write_shot(lambda: make_writer("bounds"), path, synthetic_shot())
lines = path.read_text().splitlines()
print(*lines[:3], sep="\n")
assert lines[0] == "frame,layer,x,y,z"
assert len(lines) == 1 + 5 * 2  # five frames, two layers
