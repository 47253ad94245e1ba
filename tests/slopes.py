"""Slopes by central differences, in torch."""


def slope(value, inputs, k, direction, step):
    """The derivative of ``value(*inputs)``, a number, along ``direction`` of the k-th input, from
    values ``step`` ahead and behind."""
    ends = []
    for sign in (1, -1):
        moved = [i.detach() for i in inputs]
        moved[k] = moved[k] + sign * step * direction
        ends.append(float(value(*moved)))
    return (ends[0] - ends[1]) / (2 * step)
