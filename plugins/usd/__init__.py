"""USD writer: one ``.usdc`` a shot, with textures beside it, and the rules that check such a file."""

from .check import Finding, check_usd
from .writer import UsdWriter

__all__ = ["Finding", "UsdWriter", "check_usd"]
