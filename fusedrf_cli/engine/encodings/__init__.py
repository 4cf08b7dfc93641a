"""Encodings: what turns a point in a field's box into features; one file each, of the same functions.

For the loops, compiled (kernels/assembled.py says how their names are read), with `unit` the point in the
unit cube of the box, three float64:
    locate(field, unit)        `cell`, what the others need to know of a point: an int or a tuple; left out:
                               the point. None: the cell of the density's encoding
    forward(field, cell, scratch, out, base)
                               the WIDTH features into out[base:]
    backward(field, cell, d, base, scratch, grad)
                               adds to grad (P,) what d[base:], the features' gradient, sends back
    summed(field, cell, scratch), summed_backward(field, cell, d, base, scratch, grad)
                               the sum of the features, and its adjoint for d[base]: for decoders that need no
                               more, without a way by memory; others need none
    prefetch_at(field, array, cell)
                               asks for what these read of an array laid out as the field's numbers; may be
                               left out
Points may lie a rounding outside the cube; no index may. A multiple of 8 features lets them use vectors.

The density's encoding may also have
    steps_at(field, cell, unit, index)
                               for how many steps of a ray its sample of that index stands, 0 where there is
                               nothing; left
                               out: 1 in the box
    next_index(field, cell, n_steps, strides, index, p, direction, t_local, t_begin, step), is_inside(field,
    grid, p)
                               as kernels/loops.py has them
    located(field, cell, scratch)
                               the cell with what the last `summed` or `forward` has found out of it
    pack_cell(cell), unpack_cell(field, packed, unit)
                               an int from which `unpack_cell` makes the cell again, where `locate` does not
    logits(field, cell, scratch), logits_backward(field, cell, d_logits, scratch)
                               what it adds to the three logits of the colour, and what they send back, which
                               waits in scratch for the way back of the density

For Python, with `options` what a field's shape says of the encoding:
    sizes(**options)           constants: WIDTH, ROOM (numbers of scratch, if any, which lie from AT on), and
                               its own
    sections(resolution, **options)
                               its numbers, if any: a list of ParameterBlocks (fields/box.py), whose names get
                               a prefix
    Arrays, arrays(field, starts, **options)
                               what the functions read beside `field.params`, if anything: a NamedTuple, and
                               that of a field where its sections begin at starts in `params`
    reference(field, sections, unit, read, **options)
                               (N, WIDTH) features of its sections at unit (N, 3), in plain torch; `read` is
                               what the slot that it reads hands on (kernels/assembled.py), or None
    bound(sections, read, **options)
                               (WIDTH,) float64 the largest magnitude that each feature can reach; of fields
                               over a box; or bound_within(reach, sections, **options) of one whose points
                               are those of the frame, and no coordinate of the box is beyond reach
    logits_reference(field, sections, unit, **options), logits_bound(sections, **options)
                               the same of `logits`: (N, 3), and one magnitude
"""
