"""A picture of splats by Mitsuba 3.9, whose Python may be another: PYTHON benchmarks/mitsuba_splats.py IN OUT

IN is an .npz with centres, scales, rotations (w x y z), opacities, harmonics, camera_to_world (OpenGL axes),
focal in pixels, and size. OUT gets `picture` (size, size, 3), premultiplied, and `alpha`. DRJIT_LIBLLVM_PATH
names a libLLVM of version 16 or newer.
"""

import sys

import mitsuba as mi
import numpy as np

SAMPLES = 16
MOST_SPLATS = 512  # that a ray meets

if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    given = np.load(sys.argv[1])
    size, count = int(given["size"]), len(given["centres"])
    rows = np.concatenate([given["centres"], given["scales"], np.roll(given["rotations"], -1, 1)], 1)
    pose = given["camera_to_world"] @ np.diag([-1.0, 1, -1, 1])  # it looks along +z, with +x to the left
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba"}
    scene = {
        "type": "scene",
        "integrator": {
            "type": "volprim_rf_basic", "max_depth": MOST_SPLATS, "rr_depth": MOST_SPLATS,
            "hide_emitters": True, "srgb_primitives": False,
        },
        "sensor": {
            "type": "perspective", "fov": float(np.degrees(2 * np.arctan(size / 2 / given["focal"]))),
            "to_world": mi.ScalarTransform4f(pose), "film": film | {"rfilter": {"type": "box"}},
        },
        "splats": {
            "type": "ellipsoids", "data": mi.TensorXf(rows.astype(np.float32)),
            "opacities": mi.TensorXf(given["opacities"].reshape(-1, 1)),
            "sh_coeffs": mi.TensorXf(given["harmonics"].reshape(count, -1)),
        },
    }  # fmt: skip
    shown = np.array(mi.render(mi.load_dict(scene), spp=SAMPLES))
    np.savez(sys.argv[2], picture=shown[..., :3], alpha=shown[..., 3])
