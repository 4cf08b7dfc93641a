"""Decoders: what turns features into density (of slot `sigma`) or into the logits of a colour (of slot
`rgb`), which the field's activation makes a colour of (activations.py); one file each.

For the loops, compiled, beside what encodings have (engine/encodings):
    of sigma   forward(field, cell, scratch) -> (σ per length of the coordinates, `pre`)
               backward(field, cell, pre, d_sigma, scratch, grad)
    of rgb     ray_setup(field, d, scratch), ray_backward(field, d, scratch, grad)
                               once per ray before the first colour and after the last backward: fold the unit
                               direction d; send its gradient back, and leave 0 what has gathered it; may be
                               left out
               point_setup(field, unit, scratch)
                               before `forward`, where that reads the point in the unit cube; may be left out
               forward(field, cell, d, scratch, memory, at) -> three logits
                               leaves KEPT numbers in memory[at:]
               backward(field, cell, d, d_logits, scratch, memory, at, grad)
They call what they read `features_forward`, `features_backward`, `features_summed`, ...

For Python: Arrays, sizes (with KEPT, for rgb, and what kernels/loops.py lets a kind say: LEARN_FROM,
SHADING_COST), sections and arrays as encodings have them, and
    of sigma   reference(field, sections, features, **options) -> ((N,) σ, what is handed on, or None)
    of rgb     reference(field, sections, features, dirs, **options) -> (N, 3) logits; with `unit` (N, 3) as
               well where it has a point_setup
    bound(field, sections, features, **options)
                               of the density before activation, or of a logit, the largest magnitude that is
                               reached from features of at most these magnitudes (WIDTH,); of sigma with what
                               is handed on, or None
    Options                    of what stored fields may be assembled of: a struct of what is called with,
                               but for widths, which follow from the encoding (kinds/assembled)
"""
