"""Where photos show an object and where nothing is: by their alpha, by masks, or by a white ground.

An alpha channel may say nothing, and borders of one colour may be a film's bars: so the photos are looked at.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from formats.capture_frame import evenly, nearest_point
from formats.images import oriented, read_alpha, read_image
from formats.photos import OPAQUE, decoded, decoders, load_ignored
from formats.views import View

LOOKED_AT = 100_000_000
"""Stored pixels that are decoded, about, to see what alpha or a ground says: a second or two."""
LEAST_LOOKED_AT = 12
"""Photos that are looked at however large they are."""
FAINT = 8
"""Alpha of 255 below which a pixel shows nothing."""
TRANSPARENT = 0.005
"""Share of a photo's pixels that are transparent at least, if alpha says something: a stray one does not."""
SOFT = 0.15
"""Share of half transparent pixels from which alpha is a vignette, not the outline of a thing."""
BORDER_KEPT = 0.3
"""What keeps less than this share of the photos' borders cuts out an object; other masks hide passers-by."""
BORDER_SHOWN = 0.4
"""Alpha that keeps more than this share of the borders cuts out no object, whatever it leaves out inside: the
sky, passers-by, a sign in a corner."""
SPANNED = 0.9
"""Share of a photo's shorter side that the picture of a lens spans at least."""
SOFT_LEVELS = 26, 230
"""Alpha of pixels whose colour tells whether it was multiplied by that."""
LEAST_SOFT, DARK, ABOVE = 100, 0.3, 0.001
"""How many of these tell it, at least; the share of their alpha that their colour is at least, halfway, since
black ones do not; and the share of them that may have a brighter colour than alpha, if it was."""
SAMPLED = 12
"""Photos whose borders are looked at for a ground of one colour, or colours for alpha in them, before more
are."""
WHITE, PLAIN, BARS_PLAIN = 250, 3, 12
"""The least level of a white ground, and levels by which its colour may vary, and that of a film's bars."""
GROUND = 8
"""Levels by which a pixel of an object differs from the white ground."""
STRAY = 0.02
"""Share of a border that may have another colour than a white ground, as around an object in a JPEG."""
MOSTLY = 0.65
"""Share of photos that show an object on white all around, at least, if the others cut it off."""
BARS = 0.97
"""Share of the box around it that a picture between bars fills; hardly any outline of an object does."""
BESIDE = ("above and below", "left and right")
BARS_NOTE = (
    "photos have bars {} of one colour ({}), which are learnt as if they were seen; crop them away, and take "
    "as many pixels off the cameras' centres, or mask them"
)
CELLS = 32
"""Along a side of the grid in which the box of an object is looked for, twice."""
AMISS, AMISS_ON_WHITE = 0.1, 0.34
"""Share of the outlines that may exclude a place where the object is: some are wrong, and what is white on
white is in none."""
RARELY = 0.5
"""Of the median number of views that show a place which outlines leave: what fewer show lies beside it."""
LEAST_WHOLE = 3
"""Outlines that their photos do not cut off, at least, if they are to tell how large the object is."""
MARGIN = 1.05
"""Factor on how far the rays around an object pass its middle."""


@dataclass(frozen=True)
class Outline:
    """What a photo shows of an object, where the rest of it shows nothing."""

    box: tuple[float, float, float, float] | None
    """Left, top, right, bottom around it, in pixels of the view; None where nothing of it is shown."""
    filled: float
    """Share of that box."""
    border: float
    """Share of the pixels along the photo's borders."""
    middle: float
    """Opaque ones, of the pixels of its middle, half as wide and high."""
    soft: float = 0.0
    """Share of the photo's pixels that are neither opaque nor transparent."""
    clear: float = 0.0
    """Share of the photo's pixels that are transparent."""

    @classmethod
    def of(
        cls, mask: np.ndarray, scale: float, solid: np.ndarray | None = None, **shares: float
    ) -> "Outline":
        """The outline of what is mask (H, W) of a photo, whose pixel is `scale` of the view's; `solid` is
        what of it is opaque."""
        high, wide = mask.shape
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        middle = (mask if solid is None else solid)[
            high // 4 : high - high // 4, wide // 4 : wide - wide // 4
        ]
        border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
        box, filled = None, 0.0
        if len(rows):
            left, top, right, bottom = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
            box = tuple(float(side) * scale for side in (left, top, right, bottom))
            filled = float(mask[top:bottom, left:right].mean())
        return cls(box, filled, *(float(part.mean()) for part in (border, middle)), **shares)


def alpha_outline(view: View) -> Outline:
    """What the alpha of a view's photo keeps."""
    alpha = oriented(read_alpha(view.image_path), view.orientation)
    levels = np.bincount(alpha.ravel(), minlength=256) / alpha.size
    clear, soft = float(levels[:OPAQUE].sum()), float(levels[FAINT : 255 - FAINT].sum())
    most = int(levels.argmax())
    if levels[most] == 1 or most >= FAINT and levels[most] > 1 - TRANSPARENT:  # the same all over
        clear = soft = 0.0
    return Outline.of(alpha >= FAINT, 1 / view.reduction, alpha >= OPAQUE, clear=clear, soft=soft)


def shown_pixels(view: View) -> np.ndarray:
    """(H, W) bool: what a view's mask keeps and its alpha shows. Raises as `load_ignored`."""
    shown = np.ones((view.height, view.width), bool) if view.mask_path is None else ~load_ignored(view)
    if view.pixels is not None:
        return shown & (oriented(view.pixels, view.orientation)[..., 3] >= FAINT)
    if view.image_path is None or not view.alpha:
        return shown
    alpha = oriented(read_alpha(view.image_path), view.orientation)[:: view.reduction, :: view.reduction]
    return shown & (alpha[: view.height, : view.width] >= FAINT)


def outlines(views: Sequence[View], outline: Callable[[View], Outline]) -> list[Outline]:
    """One of each view."""
    with decoders(views) as threads:
        return list(threads.map(outline, views))


def sampled(views: Sequence[View]) -> list[View]:
    """As many views, evenly spaced in the list, as are quickly decoded."""
    each = np.mean([view.width * view.height * view.reduction**2 for view in views])
    count = min(len(views), max(LEAST_LOOKED_AT, int(LOOKED_AT / each)))
    return [views[i] for i in evenly(len(views), count)]


def few(views: Sequence[View]) -> list[View]:
    """SAMPLED of the views, evenly spaced in the list."""
    return [views[i] for i in evenly(len(views), SAMPLED)]


# --- alpha --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Shown:
    """What of a capture's photos is nothing."""

    views: tuple[View, ...]
    looked_at: tuple[View, ...] = ()
    outlines: tuple[Outline, ...] = ()
    """Of those views, where they show an object that stands free."""
    notes: tuple[str, ...] = ()


def by_alpha(views: tuple[View, ...]) -> Shown:
    """Outlines where the alpha of photos cuts out what they show; without, their alpha is that of a mask, or
    says nothing (View.alpha)."""
    having = [view for view in views if view.alpha and view.image_path is not None]
    if not having:
        return Shown(views)
    looked_at = sampled(having)
    all_outlines = outlines(looked_at, alpha_outline)
    telling = [outline for outline in all_outlines if outline.box]  # others show nothing at all
    transparent = [outline for outline in telling if outline.clear >= TRANSPARENT]
    share = len(transparent) / max(len(telling), 1)
    name = having[0].image_path.name
    channel = f"the alpha channel of {len(having)} of {len(views)} photos, such as {name},"
    most = share * len(having) >= 0.5 * len(views)
    if not most or _is_frame(transparent, looked_at):
        note = f"{channel} says nothing and is not used"
        if transparent:
            what = (
                "frames them or hides parts of what they show"
                if most
                else "is transparent in too few to cut an object out"
            )
            note = f"{channel} {what}: photos show surroundings; pixels that are transparent are ignored"
        return Shown(tuple(_opaque(view, bool(transparent)) for view in views), notes=(note,))
    notes = []
    if bare := len(views) - len(having):
        notes.append(
            f"{bare} of {len(views)} photos have no alpha and are left out, since it cuts out the others"
        )
    if _premultiplied(having):
        notes.append("colours of the photos were multiplied by their alpha, and are divided by it")
        having = [replace(view, premultiplied=True) for view in having]
    if share < 1:
        n_full = round((1 - share) * len(having))
        notes.append(
            f"{n_full} of {len(views)} photos show no transparency where that cuts out the others: all that "
            "they show is learnt; cut them out too, or remove them"
        )
    return Shown(tuple(having), tuple(looked_at), tuple(all_outlines), tuple(notes))


def _premultiplied(views: Sequence[View]) -> bool:
    """Whether no colour of photos is brighter than its alpha, as where that is in it already."""
    ratios = [np.empty(0)]
    for view in few(views):
        alpha = (picture := read_image(view.image_path))[..., 3]
        soft = picture[(alpha >= SOFT_LEVELS[0]) & (alpha < SOFT_LEVELS[1])].astype(float)
        ratios.append((soft[:, :3].max(1) - 2) / soft[:, 3])
    ratios = np.concatenate(ratios)
    if len(ratios) < LEAST_SOFT or np.median(ratios) < DARK:
        return False
    return bool((ratios > 1).mean() < ABOVE)


def _opaque(view: View, ignoring: bool) -> View:
    """A view whose alpha does not say where nothing is, but may say what to ignore."""
    path = view.image_path if ignoring and view.alpha and view.mask_path is None else view.mask_path
    return replace(view, alpha=False, mask_path=path)


def _is_frame(transparent: Sequence[Outline], views: Sequence[View]) -> bool:
    """Whether alpha leaves out what lies around all photos, as the corners that a lens does not show, or
    parts of what they show, and not what lies around an object."""
    keys = ("border", "middle", "soft")
    border, middle, soft = (
        float(np.mean([getattr(outline, key) for outline in transparent])) for key in keys
    )
    if border > BORDER_SHOWN or views[0].fisheye and _alike(transparent, views):
        return True
    around = border > BORDER_KEPT or soft > SOFT or _framed(transparent, views) or views[0].fisheye
    return middle > 0.995 and around


def _alike(outlines: Sequence[Outline], views: Sequence[View]) -> bool:
    """Whether all outlines have one and the same box, nearly."""
    boxes = np.array([outline.box or (0.0,) * 4 for outline in outlines])
    sides = max(max(view.width, view.height) for view in views)
    return len(boxes) > 1 and float(np.ptp(boxes, axis=0).max()) <= 0.02 * sides


def _framed(outlines: Sequence[Outline], views: Sequence[View]) -> bool:
    """Whether all outlines are one rectangle, or the round picture of a lens, nearly."""
    spans = [min(o.box[2] - o.box[0], o.box[3] - o.box[1]) if o.box else 0.0 for o in outlines]
    shorter = min(min(view.width, view.height) for view in views)
    return _alike(outlines, views) and (_filled(outlines) or min(spans) >= SPANNED * shorter)


def _filled(outlines: Sequence[Outline]) -> bool:
    """Whether outlines are rectangles, nearly."""
    return float(np.mean([outline.filled for outline in outlines])) > BARS


# --- grounds ------------------------------------------------------------------------------------------------


def by_ground(views: tuple[View, ...]) -> Shown:
    """Outlines where photos show an object on white. Borders of another colour are taken as surroundings,
    since nothing tells a black ground from the night."""
    chosen = few(views)
    seen, white, alike = [], True, True
    for view in chosen:
        seen.append(_border_colours(view))
        lowest, mostly, highest = np.moveaxis(seen, 2, 0)
        white = int((mostly[:, 0].min(1) < WHITE).sum()) <= (1 - MOSTLY) * len(chosen)
        alike = (highest.max(0) - lowest.min(0)).max(1) <= (PLAIN, BARS_PLAIN, BARS_PLAIN)
        if not (white or alike.any()):
            return Shown(views)
    part = 0 if white else int(alike.argmax())
    colour = ", ".join(f"{level:.0f}" for level in np.median(lowest[:, part], axis=0))
    if part:
        bars = BARS_NOTE.format(BESIDE[part - 1], colour)
        return Shown(views, notes=() if alike[1:].all() else (bars,))
    surroundings = (
        f"the borders of photos have one colour ({colour}) and are taken as surroundings; of an object "
        "before nothing give photos with alpha or masks, or --bounded; crop bars and frames away"
    )
    if not white:
        return Shown(views, notes=(surroundings,))
    looked_at = sampled(views)
    all_outlines = outlines(
        looked_at, lambda view: Outline.of((decoded(view)[..., :3] < 255 - GROUND).any(2), 1.0)
    )
    free = float(np.mean([outline.border <= STRAY for outline in all_outlines]))
    boxed = [outline for outline in all_outlines if outline.box]
    if free < MOSTLY or not boxed or len(boxed) >= LEAST_WHOLE and _filled(boxed):
        return Shown(views, notes=(surroundings,))
    note = (
        f"{'' if free > 0.9 else 'most '}photos show an object on white, which is taken as nothing, so that "
        "a box around it is learnt; --unbounded learns the white as well"
    )
    return Shown(views, tuple(looked_at), tuple(all_outlines), (note,))


def _border_colours(view: View) -> np.ndarray:
    """(3, 3, 3) the lowest levels along the borders of a photo, the same but for stray pixels, the highest:
    of all borders, of those above and below, and of those at the sides."""
    picture = decoded(view)[..., :3]
    rows, columns = (np.concatenate([lines[0], lines[-1]]) for lines in (picture, picture.swapaxes(0, 1)))
    parts = np.concatenate([rows, columns]), rows, columns
    return np.array([np.quantile(part, (0.0, STRAY, 1.0), axis=0) for part in parts])


# --- masks --------------------------------------------------------------------------------------------------


def by_masks(views: tuple[View, ...]) -> Shown:
    """Outlines where masks cut an object out of at least half of the photos, without the other photos."""
    masked = tuple(view for view in views if view.mask_path not in (None, view.image_path))
    bare = len(views) - len(masked)
    if 2 * len(masked) < len(views):
        note = f"{bare} of {len(views)} photos have no mask and are used as they are"
        return Shown(views, notes=(note,) if masked else ())
    all_outlines = outlines(masked, lambda view: Outline.of(~load_ignored(view), 1.0))
    seen = [outline for outline in all_outlines if outline.box]
    notes = []
    if len(seen) < len(all_outlines):
        notes.append(
            f"the masks of {len(all_outlines) - len(seen)} of {len(views)} photos exclude all of the photo"
        )
    cut_out = bool(seen) and float(np.mean([outline.border for outline in seen])) <= BORDER_KEPT
    if bare:
        what = "left out, since masks cut an object out of the others" if cut_out else "used as they are"
        notes.append(f"{bare} of {len(views)} photos have no mask and are {what}")
    if not cut_out:
        return Shown(views, notes=tuple(notes))
    return Shown(masked, masked, tuple(all_outlines), tuple(notes))


# --- the box ------------------------------------------------------------------------------------------------


def outline_box(shown: Shown, amiss: float = AMISS) -> np.ndarray:
    """(6,) box of what all but `amiss` of the outlines leave room for an object in, in world units; a cube
    around what they show where they leave nothing. A view says nothing of what its picture does not reach."""
    pairs = [(v, o) for v, o in zip(shown.looked_at, shown.outlines, strict=True) if o.box is not None]
    views, boxes = [view for view, _ in pairs], [outline.box for _, outline in pairs]
    box = _around(views, boxes)
    for _ in range(2):  # a coarse look, and a finer one into what that leaves
        box = _narrowed(box, views, boxes, amiss)
    return box


def _around(views: Sequence[View], boxes: Sequence[tuple]) -> np.ndarray:
    """(6,) cube that holds what the outlines show, as those tell that their photos do not cut off; without
    any, as far as the cameras."""
    sizes = np.array([(view.width, view.height) for view in views])
    inside = (np.array(boxes)[:, :2] > 1).all(1) & (np.array(boxes)[:, 2:] < sizes - 1).all(1)
    usable = inside if inside.sum() >= LEAST_WHOLE else np.ones(len(views), bool)
    eyes = np.array([view.camera_to_world[:3, 3] for view in views])[usable]
    corners = [view.corners(1.0, box) for view, box, tells in zip(views, boxes, usable, strict=True) if tells]
    rays = np.array(corners) - eyes[:, None]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    middles = rays.mean(1) / np.linalg.norm(rays.mean(1), axis=1, keepdims=True)
    centre = nearest_point(eyes, middles)
    away = np.linalg.norm(np.cross(centre - eyes[:, None], rays), axis=2).max(1)
    half = MARGIN * float(np.quantile(away, 1 - AMISS / 2))
    if usable is not inside:
        half = max(half, float(np.median(np.linalg.norm(eyes - centre, axis=1))))
    return np.concatenate([centre - half, centre + half])


def _narrowed(box: np.ndarray, views: Sequence[View], boxes: Sequence[tuple], amiss: float) -> np.ndarray:
    """The box (6,) of those of CELLS³ cells of a box that most outlines leave; all where none is left."""
    low, cell = box[:3], (box[3:] - box[:3]) / CELLS
    steps = np.stack(np.meshgrid(*[np.arange(CELLS)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points, reach = low + (steps + 0.5) * cell, float(np.linalg.norm(cell)) / 2
    seen, excluded = np.zeros((2, len(points)), np.int32)
    for view, (left, top, right, bottom) in zip(views, boxes, strict=True):
        column, row, away, inside = view.shown(points)
        slack = reach * max(view.fl_x, view.fl_y) / np.maximum(away, 1e-9)
        beside = np.maximum(np.maximum(left - column, column - right), np.maximum(top - row, row - bottom))
        seen += inside
        excluded += inside & (beside > slack)
    left = (seen > 0) & (excluded <= amiss * seen)
    cells = steps[left & (seen >= RARELY * np.median(seen[left]))] if left.any() else steps
    return np.concatenate([low + cells.min(0) * cell, low + (cells.max(0) + 1) * cell])
