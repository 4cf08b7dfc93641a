"""Where numba keeps compiled code: by where a file lies in the package, not on the disk, so that another
clone or worktree of the same code finds what one has compiled. The cache's folder is named for the code."""

from pathlib import Path

from numba.core.caching import CacheImpl, UserProvidedCacheLocator

PACKAGE = Path(__file__).parents[2]


class PackageLocator(UserProvidedCacheLocator):
    """numba's locator of a cache folder, for the files of this package."""

    @classmethod
    def from_function(cls, py_func, py_file):
        """The locator of a function of the package; None of any other, which is left to numba's own."""
        own = Path(py_file).is_relative_to(PACKAGE)
        return super().from_function(py_func, py_file) if own else None

    @classmethod
    def get_suitable_cache_subpath(cls, py_file):
        """The folder in the cache: the names of the packages that the file is in."""
        return "_".join(Path(py_file).relative_to(PACKAGE.parent).parent.parts)


def install() -> None:
    """Have numba ask PackageLocator first."""
    if PackageLocator not in CacheImpl._locator_classes:
        CacheImpl._locator_classes.insert(0, PackageLocator)
