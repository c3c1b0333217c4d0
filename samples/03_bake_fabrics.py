"""03: one garment in five fabrics, as PNG textures. Run: python samples/03_bake_fabrics.py [OUTPUT_FOLDER]"""

import sys
import tempfile
from pathlib import Path

from PIL import Image

from isp_assets.bake import FabricStyle, bake_texture
from isp_assets.synthetic import synthetic_garment

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
garment = synthetic_garment("skirt", radius=0.25)  # or Collection.load("default").bundle(...).decode(...)

styles = {
    "plain": FabricStyle.from_text(color="#b8433a"),
    "stripes": FabricStyle.from_text(kind="stripes", color="#e8e4da", accent="#30456b", scale=0.04),
    "checks": FabricStyle.from_text(kind="checks", color="#f2efe8", accent="#a02028"),
    "denim": FabricStyle.from_text(kind="denim", color="#33507c"),
    "knit": FabricStyle.from_text(kind="knit", color="#d8cfae", scale=0.006),
}
for name, style in styles.items():
    texture = bake_texture(garment, style, height=512)
    Image.fromarray(texture).save(folder / f"{name}.png")
    assert texture.shape == (512, 1024, 3)  # the front panel on the left, the back on the right
    print(folder / f"{name}.png")
