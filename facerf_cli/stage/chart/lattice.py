"""Points that lie on a grid, seen in perspective: from one point and its neighbours outward."""

from collections.abc import Iterator
from itertools import permutations

import numpy as np
from scipy.spatial import cKDTree

Place = tuple[int, int]

_NEAREST = 6  # neighbours of a point that may be its grid's
_STEP_OF_SIDE = (0.9, 3.0)  # from point to point, in sides of what is at the point
_LARGEST_RATIO = 2.0  # of sides, and of steps across to steps along
_LEAST_SINE = 0.8  # of the angle between steps along and across; a grid's diagonals have 0.7
_MISS = 0.25  # of a step, that a point may lie beside where it is looked for


def find_lattices(points: np.ndarray, sides: np.ndarray, least: int, reach: int) -> list[dict[Place, int]]:
    """Grids among points [N, 2] of things with sides [N]: index by place, `least` at least; the best first.

    Places count from the point that a grid was begun at, `reach` either way: along, then across, clockwise
    from it on the screen.
    """
    if len(points) < least:
        return []
    tree = cKDTree(points)
    found: dict[frozenset[int], dict[Place, int]] = {}
    done: set[int] = set()  # in a grid already
    for seed in range(len(points)):
        if seed in done:
            continue
        grown = [_grow(tree, sides, seed, reach, *steps) for steps in _steps(tree, sides, seed)]
        best = max(grown, key=_weight, default={})
        if len(best) >= least:
            found[frozenset(best.values())] = best
            done.update(best.values())
    return sorted(found.values(), key=_weight, reverse=True)


def _weight(grid: dict[Place, int]) -> float:
    """How many places a grid has, times how full it is: one grown along a diagonal has many and is not."""
    return len(grid) ** 2 / float(np.prod(np.ptp(list(grid), axis=0) + 1))


def _steps(tree: cKDTree, sides: np.ndarray, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of steps [2] from a point to two neighbours about square to each other, the second clockwise."""
    low, high = (share * sides[seed] for share in _STEP_OF_SIDE)
    off, near = tree.query(tree.data[seed], k=min(_NEAREST + 1, len(sides)))
    kept = near[(off > low) & (off < high) & _alike(sides[near], sides[seed])]
    for one, other in permutations(kept, 2):
        along, across = tree.data[one] - tree.data[seed], tree.data[other] - tree.data[seed]
        lengths = np.hypot(*along), np.hypot(*across)
        sine = (along[0] * across[1] - along[1] * across[0]) / (lengths[0] * lengths[1])
        if sine > _LEAST_SINE and _alike(*lengths):
            yield along, across


def _alike(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return (one < _LARGEST_RATIO * other) & (other < _LARGEST_RATIO * one)


def _grow(
    tree: cKDTree, sides: np.ndarray, seed: int, reach: int, along: np.ndarray, across: np.ndarray
) -> dict[Place, int]:
    """The grid that a point and two steps begin; each step is taken as long as the one before it was."""
    grid, steps = {(0, 0): seed}, {(0, 0): (along, across)}
    todo, members = [(0, 0)], {seed}
    while todo:
        place = todo.pop(0)
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            there = (place[0] + sign * (axis == 0), place[1] + sign * (axis == 1))
            if there in grid or max(map(abs, there)) > reach:
                continue
            step = steps[place][axis]
            start = tree.data[grid[place]]
            off, index = tree.query(start + sign * step)
            fits = off < _MISS * np.hypot(*step) and _alike(sides[index], sides[grid[place]])
            if index in members or not fits:
                continue
            members.add(index)
            taken = sign * (tree.data[index] - start)
            grid[there] = int(index)
            steps[there] = (taken, steps[place][1]) if axis == 0 else (steps[place][0], taken)
            todo.append(there)
    return grid
