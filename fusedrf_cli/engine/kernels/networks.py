"""Small networks as scalar functions, compiled once for all that have one: rectified layers, of which one may
read the input again, and a last one that is not rectified."""

import numpy as np

from fusedrf_cli.engine.kernels.primitives import (
    add_scaled,
    dense,
    dense_backward,
    device,
    dot,
    rectify,
    scatter,
)


@device
def network(inputs, hidden, layers, skip, outputs, params, starts, values, x, h, out):
    """values[out : out + outputs] of values[x : x + inputs]; what each of `layers` hidden layers makes is
    left from h on. A layer's weights (inputs, outputs), and behind them its bias, begin in params at its one
    of `starts`; those by which layer `skip`, if that is above 0, reads the input again, at the last of them.
    """
    dense(inputs, hidden, params, np.uint64(starts[0]), values, x, values, h)
    rectify(hidden, values, h)
    for layer in range(1, layers):
        below, h = h, h + np.uint64(hidden)
        dense(hidden, hidden, params, np.uint64(starts[layer]), values, below, values, h)
        if skip > 0 and layer == skip:
            for i in range(np.uint64(inputs)):
                row = np.uint64(starts[layers + 1]) + i * np.uint64(hidden)
                add_scaled(hidden, values, h, values[x + i], params, row)
        rectify(hidden, values, h)
    dense(hidden, outputs, params, np.uint64(starts[layers]), values, h, values, out)


@device
def network_backward(
    inputs, hidden, layers, skip, outputs, params, starts, values, x, h, sent, d_out, d_h, d_before, d_x, grad
):
    """Adjoint of `network` for sent[d_out : d_out + outputs]: adds to grad, and sets sent[d_x : d_x +
    inputs]. There is room in `sent` for the gradients of a layer at d_h and d_before, and where a layer reads
    the input again, for that of another input behind d_x."""
    h += np.uint64((layers - 1) * hidden)
    again = d_x + np.uint64(inputs)
    last = np.uint64(starts[layers])
    dense_backward(hidden, outputs, params, last, values, h, True, sent, d_out, sent, d_h, grad)
    for back in range(1, layers):
        layer = layers - back
        h -= np.uint64(hidden)
        start = np.uint64(starts[layer])
        dense_backward(hidden, hidden, params, start, values, h, True, sent, d_h, sent, d_before, grad)
        if skip > 0 and layer == skip:
            for i in range(np.uint64(inputs)):
                row = np.uint64(starts[layers + 1]) + i * np.uint64(hidden)
                scatter(hidden, grad, row, values[x + i], sent, d_h)
                sent[again + i] = dot(hidden, params, row, sent, d_h)
        d_h, d_before = d_before, d_h
    first = np.uint64(starts[0])
    dense_backward(inputs, hidden, params, first, values, x, False, sent, d_h, sent, d_x, grad)
    if skip > 0:
        for i in range(np.uint64(inputs)):
            sent[d_x + i] += sent[again + i]
