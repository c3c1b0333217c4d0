"""The baseline as a comparison sees it: codes to surfaces and surfaces to codes.

A peer for ``isp-assets evaluate reconstruction``, with ``tests`` on PYTHONPATH:
``--peer tests/bench/udf/reconstructor.py=RUNS/{category}``.
"""

from pathlib import Path

import numpy as np
import torch
from bench.udf.extract import ExtractReport, extract_mesh
from bench.udf.field import UdfConfig, UdfField
from bench.udf.fit import FitOptions, fit_code

from isp_assets.evaluate.reconstruction import Decoded
from isp_assets.geometry.surface_distance import Surface
from isp_assets.train.loop import CHECKPOINT, read_checkpoint


class UdfReconstructor:
    """A trained baseline.

    Args:
        field_: The network.
        codes: Code of every training garment, by name.
    """

    name = "UDF"

    def __init__(self, field_: UdfField, codes: dict[str, np.ndarray]) -> None:
        self.field = field_.eval().requires_grad_(False)
        self.codes = codes
        self.report: ExtractReport | None = None
        """What the last extraction cost."""

    @classmethod
    def load(cls, folder: Path, device: str = "cpu") -> "UdfReconstructor":
        """Read what the training wrote into a folder."""
        weights, manifest = read_checkpoint(Path(folder) / CHECKPOINT)
        config = manifest["config"]
        field_ = UdfField(UdfConfig.from_dict(config["field"]))
        field_.load_state_dict(
            {k.removeprefix("field."): w for k, w in weights.items() if k.startswith("field.")}
        )
        codes = dict(zip(config["garments"], weights["codes"].numpy(), strict=True))
        return cls(field_.to(device), codes)

    def decode(self, code: np.ndarray, resolution: int) -> Decoded:
        """The surface of a code; GeometryError if there is none."""
        vertices, faces, self.report = extract_mesh(self.field, code, resolution)
        return Decoded(Surface(vertices, faces))

    def fit(self, surface: Surface, options: FitOptions | None = None) -> np.ndarray:
        """The code of an unseen surface."""
        known = torch.from_numpy(np.stack(list(self.codes.values()))).to(self.field.floor.device)
        return fit_code(self.field, surface.vertices, surface.faces, known, options)


def reconstructor(argument: str, category: str) -> UdfReconstructor:
    """The baseline of a folder; the peer that the command line asks for."""
    del category  # the folder is that of one category
    return UdfReconstructor.load(Path(argument))
