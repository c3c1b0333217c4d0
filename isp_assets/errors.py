"""Every error the library raises on purpose.

::

    IspAssetsError                exit code 1
    ├── InputError                exit code 3   something the caller gave is wrong
    │   ├── BodyError                 body file or betas
    │   ├── MotionError               motion file, poses, frame ranges
    │   ├── BundleError               latent bundle file or its parts
    │   ├── CollectionError           collection folder, garment names
    │   ├── OutfitError               order or mix of layers
    │   ├── ShotError                 shot file
    │   ├── MeshError                 mesh file of another program
    │   └── DatasetError              training data
    ├── GeometryError             exit code 4   a mesh or curve breaks an invariant
    │   ├── GarmentError              pattern, seams, rest mesh
    │   └── DecodeError               a code gives no valid garment
    ├── DrapeError                exit code 4   a frame cannot be draped
    ├── TrainError                exit code 5   training cannot start, resume or converge
    └── PluginError               exit code 6   a plugin is missing, broken or failed to write
        └── MissingExtraError         an optional dependency is not installed

Exit code 2 is the command line's own (unknown option, missing argument);
130 means interrupted by the user.
"""


class IspAssetsError(Exception):
    """Base of all errors raised on purpose. The message says what, where, expected, got, and what to do."""

    exit_code = 1


class InputError(IspAssetsError):
    """Something the caller gave is wrong."""

    exit_code = 3


class BodyError(InputError):
    """A body file or its shape parameters are wrong."""


class MotionError(InputError):
    """A motion file, its poses or a frame range are wrong."""


class BundleError(InputError):
    """A latent bundle file is wrong, damaged, or does not match its body."""


class CollectionError(InputError):
    """A collection folder is wrong, or a garment is not in it."""


class OutfitError(InputError):
    """Garments cannot be combined in the order given."""


class ShotError(InputError):
    """A shot file is wrong."""


class MeshError(InputError):
    """A mesh file of another program is wrong, or does not look like a garment."""


class DatasetError(InputError):
    """Training data are missing, damaged or of another version."""


class GeometryError(IspAssetsError):
    """A mesh or curve breaks an invariant."""

    exit_code = 4


class GarmentError(GeometryError):
    """A pattern, its seams or its rest mesh break an invariant."""


class DecodeError(GeometryError):
    """A code gives no valid garment."""


class DrapeError(IspAssetsError):
    """A frame cannot be draped."""

    exit_code = 4


class TrainError(IspAssetsError):
    """Training cannot start, resume or converge."""

    exit_code = 5


class PluginError(IspAssetsError):
    """A plugin is missing, broken, or failed to write."""

    exit_code = 6


class MissingExtraError(PluginError):
    """An optional dependency is not installed."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(
            f"{purpose} needs the package {package!r}, which is not installed; "
            f"run: pip install 'isp-assets[{extra}]'"
        )
