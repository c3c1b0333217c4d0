"""Reading TOML with errors that name the file, the key, and what was expected."""

import difflib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from isp_assets.errors import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def read_toml(path: Path, error: type[InputError]) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        error: If the file is missing, is not UTF-8, or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise error(f"no such file: {path}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as cause:
        raise error(f"{path}: not readable as TOML: {cause}") from cause


def check_keys(
    table: Mapping[str, Any],
    expected: Mapping[str, Any],
    required: set[str],
    where: str,
    error: type[InputError],
) -> None:
    """Check the keys and value types of one table.

    Raises:
        error: For an unknown key (naming the nearest known one), a missing key, or a value of a wrong type.
    """
    for key, value in table.items():
        if key not in expected:
            near = difflib.get_close_matches(key, expected, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise error(f"{where}: unknown key {key!r}{hint} Known keys: {', '.join(sorted(expected))}")
        kinds = expected[key]
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            names = " or ".join(k.__name__ for k in kinds)
            raise error(f"{where}: {key} must be {names}, got {type(value).__name__} {value!r}")
    missing = required - set(table)
    if missing:
        raise error(f"{where}: missing key{'s' if len(missing) > 1 else ''} {', '.join(sorted(missing))}")
