"""Latent bundles: the trained networks of the package, as files.

A garment bundle holds one category: its pattern networks, the latent code of every
garment, and the displacement field that drapes them. A skin bundle and a layering
bundle hold the networks that all categories share. Weights are rounded to 16 bits
by default; buffers and codes keep their precision. Saving what was loaded gives the same bytes.
"""

import difflib
import hashlib
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.conventions import PANELS
from isp_assets.decode import decode_garment
from isp_assets.errors import BundleError
from isp_assets.garment import Garment
from isp_assets.garment_model import GarmentModel
from isp_assets.networks.atlas import Atlas, AtlasConfig
from isp_assets.networks.drape_field import DrapeField, DrapeFieldConfig
from isp_assets.networks.layering_net import LayeringConfig, LayeringNet
from isp_assets.networks.panel_field import PanelField, PanelFieldConfig
from isp_assets.networks.skin_field import SkinField, SkinFieldConfig
from isp_assets.storage import load_tensors, save_tensors

Precision = Literal["float16", "float32"]
_GARMENTS, _SKIN, _LAYERING = ("isp-assets/garments", 1), ("isp-assets/skin", 1), ("isp-assets/layering", 1)


@dataclass(frozen=True, eq=False)
class GarmentBundle:
    """All garments of one category."""

    model: GarmentModel
    codes: Mapping[str, Float[np.ndarray, " Z"]]
    """Latent code of every garment, by name."""
    body_sha256: str
    """Digest of the body that the garments were modelled on."""
    body_name: str = "default"
    drape_field: DrapeField | None = None
    """Displacements in motion; None if garments are only skinned."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """How the networks were trained; plain JSON values."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """How well they do on their training garments; plain JSON values."""
    precision: Precision = "float16"
    """That of the stored weights."""

    def __post_init__(self) -> None:
        for name, code in self.codes.items():
            if code.shape != (self.model.code_size,) or not np.isfinite(code).all():
                raise BundleError(
                    f"category {self.category!r}: the code of {name!r} must be {self.model.code_size} "
                    f"finite numbers, got shape {code.shape}"
                )
        if self.drape_field is not None and self.drape_field.config.code_size != self.model.code_size:
            raise BundleError(
                f"category {self.category!r}: the drape field expects codes of "
                f"{self.drape_field.config.code_size} numbers, the pattern networks of {self.model.code_size}"
            )

    @property
    def category(self) -> str:
        return self.model.category

    @cached_property
    def model_sha256(self) -> str:
        """Digest of the pattern networks, at the precision they are stored with: what a code belongs to."""
        digest = hashlib.sha256()
        for networks in (self.model.panel_fields, self.model.atlases):
            for side in PANELS:
                for name, value in networks[side].state_dict().items():
                    digest.update(f"{side} {name} {tuple(value.shape)}".encode())
                    digest.update(value.half().cpu().numpy().tobytes())
        return digest.hexdigest()

    def with_code(self, name: str, code: Float[np.ndarray, " Z"]) -> "GarmentBundle":
        """The bundle with one garment more.

        Raises:
            BundleError: If the name is taken.
        """
        if name in self.codes:
            raise BundleError(f"bundle {self.category!r} has a garment {name!r} already; choose another name")
        return replace(self, codes={**self.codes, name: code})

    def code(self, name: str) -> Float[np.ndarray, " Z"]:
        """The latent code of a garment.

        Raises:
            BundleError: If the bundle has no garment of that name; the message names the nearest ones.
        """
        if name not in self.codes:
            near = difflib.get_close_matches(name, self.codes, n=3) or list(self.codes)[:5]
            raise BundleError(
                f"bundle {self.category!r} has no garment {name!r}; "
                f"it has {len(self.codes)}, as {', '.join(near)}"
            )
        return self.codes[name]

    def decode(self, garment: str | Float[np.ndarray, " Z"], *, resolution: int = 128) -> Garment:
        """Make a garment from its name or from a latent code.

        Args:
            garment: Name in ``codes``, or a code.
            resolution: Grid cells across a panel's square, 32 to 512.

        Raises:
            BundleError: If the bundle has no garment of that name.
            DecodeError: If the code gives no valid garment.
        """
        name = garment if isinstance(garment, str) else ""
        code = self.code(name) if isinstance(garment, str) else garment
        return decode_garment(self.model, code, resolution=resolution, name=name)

    def save(self, path: str | os.PathLike, *, dtype: Precision | None = None) -> None:
        """Write the bundle as one safetensors file, atomically.

        Args:
            path: The file.
            dtype: Precision of the weights; the bundle's own if left out.

        Raises:
            BundleError: If provenance or metrics hold what JSON cannot keep.
        """
        model = self.model
        networks: dict[str, Any] = {f"panel_field.{side}": model.panel_fields[side] for side in PANELS}
        networks |= {f"atlas.{side}": model.atlases[side] for side in PANELS}
        if self.drape_field is not None:
            networks["drape_field"] = self.drape_field
        tensors = _pack(networks, dtype or self.precision)
        codes = np.stack(list(self.codes.values())) if self.codes else np.zeros((0, model.code_size))
        tensors["codes"] = torch.from_numpy(codes.astype(np.float32))
        tensors["rest_pose"] = torch.from_numpy(np.array(model.rest_pose))
        tensors["panel_center"] = torch.from_numpy(np.array(model.panel_center))
        manifest = {
            "category": model.category, "garments": list(self.codes), "panel_scale": float(model.panel_scale),
            "edge_names": {str(label): name for label, name in model.edge_names.items()},
            "seam_pairs": [list(pair) for pair in model.seam_pairs],
            "anchor_labels": list(model.anchor_labels),
            "networks": {name: net.config.to_dict() for name, net in networks.items()},
            "body_name": self.body_name, "body_sha256": self.body_sha256,
            "provenance": dict(self.provenance), "metrics": dict(self.metrics),
        }  # fmt: skip
        save_tensors(path, tensors, manifest, schema=_GARMENTS[0], version=_GARMENTS[1])

    @classmethod
    def load(cls, path: str | os.PathLike) -> "GarmentBundle":
        """Read a bundle; networks come back in float32, on the CPU, ready to evaluate.

        Raises:
            BundleError: If the file is missing, damaged, too new or of another kind.
        """
        tensors, manifest = load_tensors(path, schema=_GARMENTS[0], version=_GARMENTS[1])
        with _reading(path):
            configs = manifest["networks"]
            fields, atlases = dict[str, PanelField](), dict[str, Atlas]()
            for side in PANELS:
                name = f"panel_field.{side}"
                fields[side] = _unpack(PanelField(PanelFieldConfig.from_dict(configs[name])), name, tensors)
                name = f"atlas.{side}"
                atlases[side] = _unpack(Atlas(AtlasConfig.from_dict(configs[name])), name, tensors)
            drape = None
            if "drape_field" in configs:
                config = DrapeFieldConfig.from_dict(configs["drape_field"])
                drape = _unpack(DrapeField(config), "drape_field", tensors)
            model = GarmentModel(
                category=manifest["category"], panel_fields=fields, atlases=atlases,
                edge_names={int(label): name for label, name in manifest["edge_names"].items()},
                seam_pairs=tuple((front, back) for front, back in manifest["seam_pairs"]),
                anchor_labels=tuple(manifest["anchor_labels"]), rest_pose=tensors["rest_pose"].numpy(),
                panel_center=tensors["panel_center"].numpy(), panel_scale=manifest["panel_scale"],
            )  # fmt: skip
            weight = tensors["panel_field.front.shared.layers.0.weight"]
            precision: Precision = "float16" if weight.dtype == torch.float16 else "float32"
            codes = dict(zip(manifest["garments"], tensors["codes"].numpy(), strict=True))
            return cls(
                model, codes, manifest["body_sha256"], manifest["body_name"], drape,
                manifest["provenance"], manifest["metrics"], precision,
            )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SkinBundle:
    """The diffused skinning field of a body."""

    skin_field: SkinField
    body_sha256: str
    provenance: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: str | os.PathLike, *, dtype: Precision = "float16") -> None:
        """Write the bundle as one safetensors file, atomically."""
        manifest = {"body_sha256": self.body_sha256}
        _save_network(path, _SKIN, self.skin_field, dtype, {**manifest, **_notes(self)})

    @classmethod
    def load(cls, path: str | os.PathLike) -> "SkinBundle":
        """Read a bundle.

        Raises:
            BundleError: If the file is missing, damaged, too new or of another kind.
        """
        tensors, manifest = load_tensors(path, schema=_SKIN[0], version=_SKIN[1])
        with _reading(path):
            net = _unpack(SkinField(SkinFieldConfig.from_dict(manifest["network"])), "network", tensors)
            return cls(net, manifest["body_sha256"], manifest["provenance"], manifest["metrics"])


@dataclass(frozen=True, eq=False)
class LayeringBundle:
    """The network that moves a garment clear of what it is worn over."""

    layering_net: LayeringNet
    provenance: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: str | os.PathLike, *, dtype: Precision = "float16") -> None:
        """Write the bundle as one safetensors file, atomically."""
        _save_network(path, _LAYERING, self.layering_net, dtype, _notes(self))

    @classmethod
    def load(cls, path: str | os.PathLike) -> "LayeringBundle":
        """Read a bundle.

        Raises:
            BundleError: If the file is missing, damaged, too new or of another kind.
        """
        tensors, manifest = load_tensors(path, schema=_LAYERING[0], version=_LAYERING[1])
        with _reading(path):
            net = _unpack(LayeringNet(LayeringConfig.from_dict(manifest["network"])), "network", tensors)
            return cls(net, manifest["provenance"], manifest["metrics"])


def _pack(networks: Mapping[str, nn.Module], dtype: Precision) -> dict[str, Tensor]:
    """Weights at ``dtype`` and buffers as they are, under the network's name."""
    if dtype not in ("float16", "float32"):
        raise BundleError(f"bundles are stored as float16 or float32, got {dtype!r}")
    tensors = {}
    for name, network in networks.items():
        weights = {key for key, _ in network.named_parameters()}
        for key, value in network.state_dict().items():
            stored = value.detach().cpu()
            if key in weights:
                stored = stored.to(getattr(torch, dtype))
                if not stored.isfinite().all():
                    raise BundleError(f"weight {name}.{key} is not finite as {dtype}; store it as float32")
            tensors[f"{name}.{key}"] = stored
    return tensors


def _unpack(network: nn.Module, name: str, tensors: Mapping[str, Tensor]) -> Any:
    """Give a network its stored weights and make it ready to evaluate."""
    prefix = f"{name}."
    own = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
    network.load_state_dict(own)
    return network.eval().requires_grad_(False)


def _save_network(
    path: str | os.PathLike,
    kind: tuple[str, int],
    network: Any,
    dtype: Precision,
    manifest: dict[str, Any],
) -> None:
    content = {**manifest, "network": network.config.to_dict()}
    save_tensors(path, _pack({"network": network}, dtype), content, schema=kind[0], version=kind[1])


def _notes(bundle: SkinBundle | LayeringBundle) -> dict[str, Any]:
    return {"provenance": dict(bundle.provenance), "metrics": dict(bundle.metrics)}


@contextmanager
def _reading(path: str | os.PathLike) -> Iterator[None]:
    """Name the file when its content does not fit together."""
    try:
        yield
    except BundleError as error:
        raise BundleError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise BundleError(
            f"{path}: the content does not fit the manifest ({reason}); the file is damaged"
        ) from error
