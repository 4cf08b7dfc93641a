"""Looking ahead: templates beside those of loops.py, for kinds whose density is a network, which asks for the
next samples of a ray, or the next points, together (lanes.py).

What such a kind has, with scratch as in loops.py and LANES and LANE_ROOM among its sizes:
    lane_of(field, p, scratch)              the lane that knows what is at p, or -1
    enter_lane(field, grid, p, lane, scratch)
                                            how many lanes are in use when p has taken that one, unless there
                                            is nothing to sample
    fill_lanes(field, count, scratch)       what the density's network makes of so many lanes
Its `density` and `colour` look into the lanes first.
"""

LANES = 0  # samples at once; 0: a kind looks at none before it is asked
LANE_ROOM = 0  # numbers of scratch for them, from SCRATCH on


def lane_of(field, p, scratch):
    """Nothing needs to be known."""
    return 0


def enter_lane(field, grid, p, lane, scratch):
    """No lane is taken."""
    return lane


def fill_lanes(field, count, scratch):
    """Nothing is made."""


def look_along(field, grid, line, t_begin, t_end, step, index, n_steps, scratch):
    """Know the densities of the samples of a piece, line (origin, direction, warp), from the one of `n_steps`
    steps from step `index` on, unless that is known."""
    if LANES > 0 and index >= 0:
        p = position_at(line[0], line[1], t_begin + 0.5 * midpoint(index, n_steps) * step)
        if lane_of(field, p, scratch) < 0:
            lane = enter_lane(field, grid, p, 0, scratch)
            while 0 < lane < LANES:
                index, n_steps = next_sample(grid, line[0], line[1], t_begin, t_end, step, index + n_steps)
                if index < 0:
                    break
                p = position_at(line[0], line[1], t_begin + 0.5 * midpoint(index, n_steps) * step)
                lane = enter_lane(field, grid, p, lane, scratch)
            fill_lanes(field, lane, scratch)


def look_among(field, grid, points, i, scratch):
    """The same of points (N, 3) from point i on."""
    if LANES > 0 and lane_of(field, point(triple(points, i)), scratch) < 0:
        lane = 0
        while i < points.shape[0] and lane < LANES:
            p = point(triple(points, i))
            if is_inside(field, grid, p):
                lane = enter_lane(field, grid, p, lane, scratch)
            i += 1
        fill_lanes(field, lane, scratch)


def look_into_cell(field, grid, cells, i, q, scratch):
    """The same of the points of cell i from offset q on."""
    if LANES > 0 and lane_of(field, point_of_cell(cells, i, q), scratch) < 0:
        lane = 0
        while q < cells.offsets.shape[0] and lane < LANES:
            lane = enter_lane(field, grid, point_of_cell(cells, i, q), lane, scratch)
            q += 1
        fill_lanes(field, lane, scratch)


def look_in_instance(field, grid, query, i, scratch):
    """The same of the chosen points of an instance (instances.py) from chosen[i] on."""
    if LANES > 0 and lane_of(field, chosen_point(query, i), scratch) < 0:
        lane = 0
        while i < query.chosen.shape[0] and lane < LANES:
            p = chosen_point(query, i)
            if is_inside(field, grid, p) and not is_cropped_away(query, query.chosen[i]):
                lane = enter_lane(field, grid, p, lane, scratch)
            i += 1
        fill_lanes(field, lane, scratch)
