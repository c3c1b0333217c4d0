"""02: what is in the USD file, read with plain OpenUSD. Run: python samples/02_read_usd_back.py [FILE.usdc]

Without a file, a small synthetic shot is written first.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from isp_assets import make_writer
from isp_assets.plugin_conformance import write_shot
from isp_assets.synthetic import synthetic_shot

if len(sys.argv) > 1:
    path = Path(sys.argv[1])
else:
    path = Path(tempfile.mkdtemp()) / "synthetic.usdc"
    write_shot(lambda: make_writer("usd"), path, synthetic_shot())

stage = Usd.Stage.Open(str(path))
first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
print(f"{path.name}: frames {first:g} to {last:g} at {stage.GetFramesPerSecond():g} a second")

layers = stage.GetDefaultPrim().GetChild("Garments").GetChildren()  # innermost first
for prim in layers:
    mesh = UsdGeom.Mesh(prim)
    points = np.array(mesh.GetPointsAttr().Get(last))
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened())
    travelled = np.linalg.norm(points - np.array(mesh.GetPointsAttr().Get(first)), axis=1).mean()
    print(
        f"  {prim.GetName()}: {len(points)} points, {len(st) // 3} faces; moved {travelled:.3f} m on average"
    )
    assert np.isfinite(points).all()
    assert st.min() >= 0
    assert st.max() <= 1

assert [p.GetName()[:3] for p in layers] == [f"L{k:02d}" for k in range(len(layers))]
