"""Structure from motion, in a process of its own: `python -m formats.mapper FOLDER`.

pycolmap's picture codecs collide with Pillow's where both are loaded, its calls cannot be interrupted, and a
fault in it ends its process. So this module imports nothing but pycolmap and numpy, and `formats.posing`
starts it, listens to it and ends it.

FOLDER holds `job.json` and the pictures it names. `model/` is left there, COLMAP's binary files of the
largest model, if there is any. Each line on stdout is a JSON object: the phases with their totals, how much
of them is done, and last what came out. The process ends when its stdin does, that is, with its parent.
"""

import contextlib
import json
import os
import signal
import sqlite3
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np

MAX_SIDE = 1600
"""Pixels of the longer side of the pictures that features are looked for in."""
MAX_FEATURES = 4096
CAMERA = "SIMPLE_RADIAL"
"""COLMAP's model of the cameras: one focal length, one number of distortion."""
EXHAUSTIVE = 80
"""Up to so many photos each is compared with every other."""
NEIGHBOURS = 10
"""Of more photos each is compared with so many that follow it, as the frames of a film do."""
ALIKE = 15
"""And with so many that look most like it, so that a walk around something closes."""
WORDS = 64
"""Clusters of features by which photos are compared as a whole."""
SAMPLED = 100_000
"""Features that the clusters are made of."""
PAIRS_AT_ONCE = 20
"""Pairs that are stored together: progress is counted in these."""
SEED = 0
LEAST_MODEL = 3
"""A model of fewer photos is none."""


def main(folder: Path) -> None:
    """Pose the pictures of a folder, telling of it on stdout."""
    import pycolmap

    _die_plainly()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pycolmap.logging.minloglevel = 2  # errors; the rest is told in lines of our own
    job = json.loads((folder / "job.json").read_text())
    database, names = folder / "database.db", sorted(sum((c["photos"] for c in job["cameras"]), []))
    _import(pycolmap, folder, database, job["cameras"])
    features = _extract(pycolmap, folder, database, names, job["threads"])
    _match(pycolmap, folder, database, names, job["threads"])
    models = _map(pycolmap, folder, database, len(names), job["threads"])
    if models:
        (folder / "model").mkdir()
        models[0].write(folder / "model")
    _say(
        features=features,
        models=[model.num_reg_images() for model in models],
        error=models[0].compute_mean_reprojection_error() if models else None,
    )


def _die_plainly() -> None:
    """Take the place of pycolmap's handlers of faults, which wait for ever where memory is damaged."""
    for number in (signal.SIGABRT, signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL):
        signal.signal(number, signal.SIG_DFL)


def _end_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)  # nothing ever comes
    os._exit(1)


def _say(**facts) -> None:
    print(json.dumps(facts), flush=True)


# --- features -----------------------------------------------------------------------------------------------


def _import(pycolmap, folder: Path, database: Path, cameras: list[dict]) -> None:
    """List pictures and cameras in a new database, in one order whatever threads do later."""
    pycolmap.Database.open(database).close()
    for camera in cameras:
        options = pycolmap.ImageReaderOptions(camera_model=CAMERA)
        if camera["focal"] is not None:
            options.camera_params = f"{camera['focal']},{camera['width'] / 2},{camera['height'] / 2},0"
        pycolmap.import_images(
            database, folder, pycolmap.CameraMode.SINGLE, image_names=camera["photos"], options=options
        )


def _extract(pycolmap, folder: Path, database: Path, names: list[str], threads: int) -> list[int]:
    """How many features were found in each picture."""
    options = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False, max_image_size=MAX_SIDE)
    options.sift.max_num_features = MAX_FEATURES
    with _counting("features", len(names), database, "keypoints"):
        pycolmap.extract_features(database, folder, image_names=names, extraction_options=options)
    with contextlib.closing(sqlite3.connect(database)) as connection:
        rows = connection.execute("SELECT name, rows FROM images LEFT JOIN keypoints USING (image_id)")
        counts = dict(rows.fetchall())
    return [counts.get(name) or 0 for name in names]


@contextlib.contextmanager
def _counting(phase: str, total: int, database: Path, table: str) -> Iterator[None]:
    """Say every half second how many rows a table has, while a call fills it."""
    _say(phase=phase, total=total)
    over = threading.Event()

    def count() -> None:
        while not over.wait(0.5):
            # A database that is just being written may refuse; the next look will do.
            with contextlib.suppress(sqlite3.Error):
                with contextlib.closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as reader:
                    _say(done=reader.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])

    counter = threading.Thread(target=count)
    counter.start()
    try:
        yield
    finally:
        over.set()
        counter.join()


# --- pairs --------------------------------------------------------------------------------------------------


def _match(pycolmap, folder: Path, database: Path, names: list[str], threads: int) -> None:
    count = len(names)
    if count <= EXHAUSTIVE:
        pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    else:
        _say(phase="comparing", total=None)
        pairs = likely_pairs(_descriptors(pycolmap, database, names))
    listed = folder / "pairs.txt"
    listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs))
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listed, block_size=PAIRS_AT_ONCE)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    with _counting("matching", len(pairs), database, "two_view_geometries"):
        pycolmap.match_image_pairs(database, matching, pairing, verification)


def _descriptors(pycolmap, database: Path, names: list[str]) -> list[np.ndarray]:
    """(M, 128) uint8 of each picture."""
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        return [np.asarray(opened.read_descriptors(ids[name]).data).reshape(-1, 128) for name in names]


def likely_pairs(descriptors: list[np.ndarray]) -> list[tuple[int, int]]:
    """Pairs i < j of pictures that may show the same: those near in the list, and those that look alike.

    Looks are compared by what the features differ from the middles of their clusters (VLAD), which needs no
    vocabulary of other pictures.
    """
    count = len(descriptors)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + 1 + NEIGHBOURS))}
    looks = _looks(descriptors)
    likeness = looks @ looks.T
    np.fill_diagonal(likeness, -np.inf)
    for i, row in enumerate(likeness):
        alike = np.argsort(-row, kind="stable")[: min(ALIKE, count - 1)]  # itself comes last
        pairs |= {(min(i, j), max(i, j)) for j in alike.tolist()}
    return sorted(pairs)


def _looks(descriptors: list[np.ndarray]) -> np.ndarray:
    """(N, WORDS * 128) float32 of unit length, or 0 for a picture without features."""
    random = np.random.default_rng(SEED)
    share = max(1, sum(map(len, descriptors)) // SAMPLED)
    sample = np.concatenate([found[::share] for found in descriptors]).astype(np.float32)
    words = sample[random.permutation(len(sample))[:WORDS]]
    for _ in range(10):  # Lloyd's iteration
        nearest = _nearest(sample, words)
        words = np.stack(
            [sample[nearest == i].mean(0) if (nearest == i).any() else word for i, word in enumerate(words)]
        )
    looks = np.zeros((len(descriptors), len(words), sample.shape[1]), np.float32)
    for look, found in zip(looks, descriptors, strict=True):
        if len(found):
            nearest = _nearest(found.astype(np.float32), words)
            np.add.at(look, nearest, found - words[nearest])
    looks = (np.sign(looks) * np.sqrt(np.abs(looks))).reshape(len(descriptors), -1)
    return looks / np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-6)


def _nearest(found: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.argmin((words**2).sum(1) - 2 * found @ words.T, axis=1)


# --- mapping ------------------------------------------------------------------------------------------------


def _map(pycolmap, folder: Path, database: Path, count: int, threads: int) -> list:
    """The models, the largest first."""
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=threads, random_seed=SEED, min_model_size=LEAST_MODEL, extract_colors=True
    )
    options.mapper.random_seed = options.triangulation.random_seed = SEED
    placed = 0

    def began() -> None:
        nonlocal placed
        placed = 2
        _say(done=placed)

    def came() -> None:
        nonlocal placed
        placed += 1
        _say(done=min(placed, count))

    _say(phase="mapping", total=count)
    (folder / "models").mkdir()
    found = pycolmap.incremental_mapping(
        database,
        folder,
        folder / "models",
        options,
        initial_image_pair_callback=began,
        next_image_callback=came,
    )
    return sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
