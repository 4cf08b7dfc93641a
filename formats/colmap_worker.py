"""Structure from motion, in a process of its own: `python -m formats.colmap_worker FOLDER`.

pycolmap's picture codecs collide with Pillow's where both are loaded, its calls cannot be interrupted, and a
fault in it ends its process. So this module imports nothing but pycolmap, numpy and scipy, and
`formats.posing` starts it, listens to it and ends it.

FOLDER holds `job.json` and the pictures it names. `model/` is left there, COLMAP's binary files of the
largest model, if there is any. Each line on stdout is a JSON object: the phases with their totals, how much
of them is done, and last what came out. The process ends when its stdin does, that is, with its parent.
"""

import json
import os
import signal
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

MAX_SIDE = 1600
"""Pixels of the longer side of the pictures that features are looked for in."""
MAX_FEATURES = 4096
CAMERA = "SIMPLE_RADIAL"
"""COLMAP's model of the cameras: one focal length, one number of distortion."""
REFINED = 30
"""Cameras of so many photos each get at last two focal lengths, a centre and four numbers of distortion."""
CENTRE = 0.05
"""A centre farther than this share of a side from the picture's middle is not believed."""
EXHAUSTIVE = 60
"""Up to so many photos each is compared with every other."""
NEIGHBOURS = 10
"""Of more photos each is compared with so many that follow it, as the frames of a film do."""
ALIKE = 15
"""And with so many that look most like it, so that a walk around something closes."""
WORDS = 64
"""Clusters of features by which photos are compared as a whole."""
SAMPLED = 100_000
"""Features that the clusters are made of."""
PER_THREAD, MATCHINGS = 4, 10
"""Pictures per thread whose features are looked for in one call, and calls in which all pairs are compared:
progress is counted in these. Each call has to index its pictures' features anew."""
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
    error = _keep(pycolmap, folder / "model", models[0], job["threads"]) if models else None
    _say(features=features, models=[model.num_reg_images() for model in models], error=error)


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
    for some in _parts("features", names, PER_THREAD * threads):
        pycolmap.extract_features(database, folder, image_names=some, extraction_options=options)
    with pycolmap.Database.open(database) as opened:
        ids = _ids(opened)
        return [opened.num_keypoints_for_image(ids[name]) for name in names]


def _parts(phase: str, items: list, length: int) -> Iterator[list]:
    """The items, so many at a time, telling of it: calls of pycolmap say nothing while they run.

    Nor may anybody look into the database from here meanwhile: Python's SQLite is another than pycolmap's,
    and where two of them have one file open in one process, it is damaged.
    """
    _say(phase=phase, total=len(items))
    for i in range(0, len(items), length):
        yield items[i : i + length]
        _say(done=min(i + length, len(items)))


def _ids(opened) -> dict[str, int]:
    return {image.name: image.image_id for image in opened.read_all_images()}


# --- pairs --------------------------------------------------------------------------------------------------


def _match(pycolmap, folder: Path, database: Path, names: list[str], threads: int) -> None:
    count = len(names)
    if count <= EXHAUSTIVE:
        pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    else:
        _say(phase="comparing", total=None)
        pairs = matching_pairs(_descriptors(pycolmap, database, names))
    listed = folder / "pairs.txt"
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    for some in _parts("matching", pairs, max(1, -(-len(pairs) // MATCHINGS))):
        listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in some))
        pycolmap.match_image_pairs(database, matching, pairing, verification)


def _descriptors(pycolmap, database: Path, names: list[str]) -> list[np.ndarray]:
    """(M, 128) uint8 of each picture."""
    with pycolmap.Database.open(database) as opened:
        ids = _ids(opened)
        return [np.asarray(opened.read_descriptors(ids[name]).data).reshape(-1, 128) for name in names]


def matching_pairs(descriptors: list[np.ndarray]) -> list[tuple[int, int]]:
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
    from scipy.cluster.vq import kmeans2, vq

    random = np.random.default_rng(SEED)
    share = max(1, sum(map(len, descriptors)) // SAMPLED)
    sample = np.concatenate([picture_descriptors[::share] for picture_descriptors in descriptors]).astype(
        np.float32
    )
    if not len(sample):
        return np.zeros((len(descriptors), 1), np.float32)
    words = sample[random.permutation(len(sample))[:WORDS]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of clusters without features, which stay where they were
        words, _ = kmeans2(sample, words, 10, minit="matrix")
    looks = np.zeros((len(descriptors), len(words), sample.shape[1]), np.float32)
    for look, picture_descriptors in zip(looks, descriptors, strict=True):
        if len(picture_descriptors):
            nearest, _ = vq(picture_descriptors.astype(np.float32), words)
            np.add.at(look, nearest, picture_descriptors - words[nearest])
    looks = (np.sign(looks) * np.sqrt(np.abs(looks))).reshape(len(descriptors), -1)
    return looks / np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-6)


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
    models = pycolmap.incremental_mapping(
        database,
        folder,
        folder / "models",
        options,
        initial_image_pair_callback=began,
        next_image_callback=came,
    )
    return sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _keep(pycolmap, folder: Path, model, threads: int) -> float:
    """Write a model, its lenses refined where that is to be believed; returns its mean error in pixels."""
    folder.mkdir()
    model.write(folder)
    error = model.compute_mean_reprojection_error()
    if _refined(pycolmap, model, threads):
        model.write(folder)
        error = model.compute_mean_reprojection_error()
    return error


def _refined(pycolmap, model, threads: int) -> bool:
    """Fit the lenses of a model more closely, and say whether the result is to be used.

    Few photos do not tell a lens that is off centre from a camera that is turned.
    """
    photos = Counter(model.images[i].camera_id for i in model.reg_image_ids())
    if min(photos.values()) < REFINED:
        return False
    _say(phase="refining", total=None)
    cameras = [model.cameras[i] for i in photos]
    for camera in cameras:
        f, x, y, k = camera.params
        camera.model, camera.params = pycolmap.CameraModelId.OPENCV, [f, f, x, y, k, 0, 0, 0]
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.solver_options.num_threads = threads
    pycolmap.bundle_adjustment(model, options)
    sides = np.array([(camera.width, camera.height) for camera in cameras])
    centres = np.array([camera.params[2:4] for camera in cameras])
    return bool((np.abs(centres / sides - 0.5) < CENTRE).all())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
