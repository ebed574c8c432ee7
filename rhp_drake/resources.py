"""Finds `models/` and `scenarios/`, in a checkout and in an installed wheel."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

from rhp_drake.errors import InputError

if TYPE_CHECKING:
    from pydrake.multibody.parsing import PackageMap

_PACKAGE_URI: Final = "package://rhp_drake/"


def _resource_root() -> Path:
    """The folder that holds `models` and `scenarios`."""
    package = Path(__file__).resolve().parent
    return package if (package / "models").is_dir() else package.parent


def models_path() -> Path:
    """The folder of the models, whose `package.xml` names it `rhp_drake`."""
    return _resource_root() / "models"


def scenarios_path() -> Path:
    """The folder of the scenarios that come with the package."""
    return _resource_root() / "scenarios"


def make_package_map() -> "PackageMap":
    """The only package map in use: it knows `package://rhp_drake`, nothing remote."""
    from pydrake.multibody.parsing import PackageMap

    package_map = PackageMap.MakeEmpty()
    package_map.AddPackageXml(str(models_path() / "package.xml"))
    return package_map


def resolve(uri: str) -> Path:
    """The file that a `package://rhp_drake/...` URI or a plain path names.

    Raises:
        InputError: If the URI names another package.
    """
    if uri.startswith(_PACKAGE_URI):
        return models_path() / uri.removeprefix(_PACKAGE_URI)
    if "://" in uri:
        raise InputError(f"{uri}: only {_PACKAGE_URI} and plain paths are known.")
    return Path(uri)
