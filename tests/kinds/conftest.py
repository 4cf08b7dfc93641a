"""The tiny shop of the bridge's tests, for every kind of field."""

from tests.bridge.conftest import folder, picture, report, run, shop, tiny

__all__ = ["folder", "picture", "report", "run", "shop", "tiny"]
