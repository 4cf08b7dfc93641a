"""Where numba keeps compiled code, and how: by where a file lies in the package, not on the disk, so that
another clone or worktree of the same code finds what one has compiled; and under a checksum, so that what was
damaged is compiled again. The cache's folder is named for the code."""

import hashlib
import os
import pickle
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numba
from numba.core import caching
from numba.core.caching import CacheImpl, UserProvidedCacheLocator

PACKAGE = Path(__file__).parents[2]


class PackageLocator(UserProvidedCacheLocator):
    """numba's locator of a cache folder, for the files of this package."""

    @classmethod
    def from_function(cls, py_func, py_file):
        """The locator of a function of the package; None of any other, which is left to numba's own."""
        return cls(py_func, py_file) if Path(py_file).is_relative_to(PACKAGE) else None

    @classmethod
    def get_suitable_cache_subpath(cls, py_file):
        """The folder in the cache: the names of the packages that the file is in."""
        return "_".join(Path(py_file).relative_to(PACKAGE.parent).parent.parts)

    def ensure_cache_path(self):
        """Nothing: what cannot be kept is said when it is to be written."""


class KernelStore:
    """The compiled code of one function, each overload in a file of its own: in place of numba's
    IndexDataCacheFile, whose index and data are unpickled as they are.

    A file is the SHA-256 of what follows, and a pickle of what it is the code of and the code. A file that is
    missing, damaged or of something else counts as none: what it should hold is compiled again. What cannot
    be written is not kept, which is said once. The folder has to be its user's own: code in it is run.
    """

    warn: Callable[[str], None] = staticmethod(warnings.warn)
    said: set[str] = set()
    """What was warned of, once each."""

    def __init__(self, cache_path: str, filename_base: str, source_stamp: object):
        self.folder, self.name, self.made_of = cache_path, filename_base, (numba.__version__, source_stamp)

    def path(self, key: object) -> Path:
        """Of an overload; its key is what numba tells overloads and processors apart by."""
        return Path(self.folder, f"{self.name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.kept")

    def load(self, key: object) -> object | None:
        """What was saved under a key; None where there is nothing, or something else."""
        try:
            content = self.path(key).read_bytes()
        except OSError:
            return None
        size = hashlib.sha256().digest_size
        if hashlib.sha256(content[size:]).digest() != content[:size]:
            self.say("damaged", f"compiled kernels in {self.folder} are damaged; they are compiled again")
            return None
        made_of, saved_key, data = pickle.loads(content[size:])
        return data if (made_of, saved_key) == (self.made_of, key) else None

    def save(self, key: object, data: object) -> None:
        """Keep data under a key, whole or not at all."""
        content, temporary = caching.dumps((self.made_of, key, data)), None
        try:
            os.makedirs(self.folder, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.folder, prefix=".", delete=False) as file:
                temporary = file.name
                file.write(hashlib.sha256(content).digest() + content)
            os.replace(temporary, self.path(key))
        except OSError as error:
            if temporary is not None and os.path.exists(temporary):
                os.unlink(temporary)
            self.say(
                "lost",
                f"compiled kernels cannot be kept in {self.folder} ({error.strerror}), so that each run "
                "compiles them; free space there, or set XDG_CACHE_HOME to another folder",
            )

    def say(self, what: str, sentence: str) -> None:
        """Warn of something, once in a process."""
        if what not in self.said:
            self.said.add(what)
            KernelStore.warn(sentence)

    def flush(self) -> None:
        """See IndexDataCacheFile: forget all overloads."""
        for path in Path(self.folder).glob(f"{self.name}.*.kept"):
            path.unlink(missing_ok=True)


def install(caches: ModuleType = caching) -> None:
    """Have numba, or the GPU's compiler with a module of caches of its own, ask PackageLocator first and keep
    what lies in its cache folder as `KernelStore` does."""
    if caches is caching and PackageLocator not in CacheImpl._locator_classes:
        CacheImpl._locator_classes.insert(0, PackageLocator)
    plain = caches.IndexDataCacheFile

    def kept(cache_path: str, filename_base: str, source_stamp: object):
        is_ours = numba.config.CACHE_DIR and Path(cache_path).is_relative_to(numba.config.CACHE_DIR)
        return (KernelStore if is_ours else plain)(cache_path, filename_base, source_stamp)

    caches.IndexDataCacheFile = kept
