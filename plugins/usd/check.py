"""Checks a shot's USD file: OpenUSD's own validators, and the rules that they leave out.

OpenUSD's validators look at metadata, materials and prim structure, but not at
topology, extents, array sizes or frames; the rules here do. On the command line:
``python -m isp_assets_plugins.usd FILE...``; the exit code is 1 if anything is found.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pxr import Usd, UsdValidation

from isp_assets.errors import PluginError

from .rules import RULES


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a file."""

    rule: str
    """Name of the rule, or ``usd:`` and the name of OpenUSD's validator."""
    prim: str
    message: str

    def __str__(self) -> str:
        return f"{self.rule}: {self.prim}: {self.message}"


def check_usd(path: Path) -> list[Finding]:
    """Everything that is wrong with a shot's USD file; empty for a good one.

    Raises:
        PluginError: If the file cannot be opened at all.
    """
    try:
        stage = Usd.Stage.Open(str(path))
    except Exception as cause:
        raise PluginError(f"{path}: not a USD file that can be opened: {cause}") from cause
    own = [Finding(rule, prim, message) for rule, check in RULES.items() for prim, message in check(stage)]
    return own + list(_official(stage))


def _official(stage: Usd.Stage) -> Iterator[Finding]:
    registry = UsdValidation.ValidationRegistry()
    names = [m.name for m in registry.GetAllValidatorMetadata() if not m.isSuite]
    for error in UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(names)).Validate(stage):
        prims = [str(site.GetPrim().GetPath()) for site in error.GetSites() if site.IsPrim()]
        yield Finding(f"usd:{error.GetIdentifier()}", ", ".join(prims) or "/", error.GetMessage())
