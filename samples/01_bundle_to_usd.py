"""01: from latent codes to a .usdc file. Run: python samples/01_bundle_to_usd.py [OUTPUT_FOLDER]"""

import sys
import tempfile
from pathlib import Path

from isp_assets import Body, Collection, FrameRange, Motion, Shot, make_writer
from isp_assets.drape import drape

path = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp()) / "walk.usdc"

outfit = Collection.load("default").outfit(["tank_top", "trousers", "open_jacket"])  # innermost first
shot = Shot("walk", Body.load("default"), Motion.load("walk").select(FrameRange(1, 8)))
frames = drape(outfit, shot)
writer = make_writer("usd")
writer.begin(path, frames.scene)
for chunk in frames:
    writer.add(chunk)
writer.finish()

from isp_assets_plugins.usd import check_usd  # noqa: E402

findings = check_usd(path)
assert not findings, findings
print(
    f"{path}: {len(frames.scene.layers)} layers, {len(frames.scene.frames)} frames, nothing to complain about"
)
