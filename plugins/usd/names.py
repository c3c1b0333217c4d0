"""Prim names from free text."""

from collections.abc import Sequence

from pxr import Tf


def prim_names(names: Sequence[str]) -> list[str]:
    """Valid, distinct prim names for siblings, in order.

    A valid name is kept as it is. Characters that USD does not allow become
    underscores; a name that is taken already gets ``_2``, ``_3``, ...
    """
    taken: set[str] = set()
    found = []
    for name in names:
        base = unique = Tf.MakeValidIdentifier(name)
        count = 1
        while unique in taken:
            count += 1
            unique = f"{base}_{count}"
        taken.add(unique)
        found.append(unique)
    return found
