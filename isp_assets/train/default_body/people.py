"""A population of adults to learn the shape space from.

The spreads are chosen by eye for a plausible population; the height parameter's mean gives
men of 1.76 m and women of 1.63 m (MakeHuman's own middle gives 1.91 m and 1.77 m).
"""

import numpy as np

from isp_assets.train.default_body.makehuman import Phenotype

_Pair = tuple[str, str]


def _pair(folder: str, name: str) -> _Pair:
    return f"{folder}/{name}-decr", f"{folder}/{name}-incr"


def _both(folder: str, name: str) -> tuple[_Pair, ...]:
    return _pair(folder, f"l-{name}"), _pair(folder, f"r-{name}")


# Standard deviation of each local morph, and its targets; left and right are drawn together.
_LOCAL: tuple[tuple[float, tuple[_Pair, ...]], ...] = (
    (0.25, (_pair("torso", "torso-scale-horiz"),)),
    (0.25, (_pair("torso", "torso-scale-depth"),)),
    (0.12, (_pair("torso", "torso-scale-vert"),)),
    (0.30, (_pair("torso", "torso-vshape"),)),
    (0.25, (_pair("hip", "hip-scale-horiz"),)),
    (0.25, (_pair("hip", "hip-scale-depth"),)),
    (0.15, (_pair("legs", "upperlegs-height"),)),
    (0.15, (_pair("legs", "lowerlegs-height"),)),
    (0.15, _both("arms", "upperarm-scale-vert")),
    (0.15, _both("arms", "lowerarm-scale-vert")),
    (0.25, _both("arms", "upperarm-fat")),
    (0.25, _both("legs", "upperleg-fat")),
    (0.25, _both("legs", "lowerleg-fat")),
    (0.30, (_pair("stomach", "stomach-tone"),)),
    (0.15, (_pair("stomach", "stomach-pregnant"),)),
    (0.30, (_pair("buttocks", "buttocks-volume"),)),
    (0.25, (_pair("torso", "measure-shoulder-dist"),)),
    (0.25, (_pair("torso", "measure-waist-circ"),)),
    (0.25, (_pair("torso", "measure-hips-circ"),)),
    (0.25, (_pair("neck", "neck-scale-horiz"),)),
    (0.20, (_pair("neck", "neck-scale-vert"),)),
)


def random_adult(generator: np.random.Generator) -> Phenotype:
    """Draw one adult. The order of the draws is part of the result: the default body depends on it."""
    normal = generator.normal
    female = generator.random() < 0.5
    blur = abs(normal(0, 0.15))  # few bodies are all man or all woman
    macro = {
        "gender": np.clip(1 - blur if female else blur, 0, 1),
        "age": np.clip(2 / 3 + abs(normal(0, 0.08)), 2 / 3, 0.9),
        "muscle": np.clip(normal(0.32 if female else 0.38, 0.18), 0, 0.95),
        "weight": np.clip(normal(0.6, 0.25), 0, 1),
        "height": normal(0.368, 0.063),
        "proportions": generator.uniform(0.2, 0.9),
        "cupsize": np.clip(normal(0.5, 0.2), 0, 1),
        "firmness": np.clip(normal(0.55, 0.2), 0, 1),
    }
    local = {}
    for deviation, pairs in _LOCAL:
        amount = float(np.clip(normal(0, deviation), -2.5 * deviation, 2.5 * deviation))
        local.update(dict.fromkeys(pairs, amount))
    race = generator.dirichlet([1, 1, 1]) + 0.05
    return Phenotype({name: float(value) for name, value in macro.items()}, tuple(race.tolist()), local)
