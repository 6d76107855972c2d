"""Parametric furniture: every piece stands on z = 0, centred in x and y, its back towards -y. Metres."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from worker.simulation.scenes.mesh import Mesh, block, box, cylinder, rigid, sphere, turned, union


def table(width: float = 1.4, depth: float = 0.7, height: float = 0.74) -> Mesh:
    """Build a top on four legs."""
    x, y, leg = width / 2 - 0.06, depth / 2 - 0.06, 0.05
    legs = [box(leg, leg, height - 0.03).at(sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1)]
    return union(box(width, depth, 0.03).at(z=height - 0.03), *legs)


def desk(width: float = 1.4, depth: float = 0.7) -> Mesh:
    """Build a table with a drawer unit beneath, a tilted monitor and a small heap of paper on top."""
    height = 0.74
    drawers = box(0.4, depth - 0.12, 0.58).at(width / 2 - 0.3)
    monitor = box(0.55, 0.03, 0.33).placed(rigid(0, -0.12, height + 0.12, yaw=8, roll=-6))
    foot = union(box(0.22, 0.16, 0.02).at(0, -0.12, height), box(0.05, 0.04, 0.16).at(0, -0.16, height))
    paper = box(0.22, 0.3, 0.09).at(-width / 2 + 0.25, 0.05, height, yaw=12)
    return union(table(width, depth, height), drawers, monitor, foot, paper)


def chair(width: float = 0.45, seat: float = 0.45) -> Mesh:
    """Build four legs, a seat and a back that leans by 10 degrees."""
    half = width / 2 - 0.03
    legs = [cylinder(0.02, seat, sides=8).at(sx * half, sy * half) for sx in (-1, 1) for sy in (-1, 1)]
    back = box(width, 0.04, 0.48).placed(rigid(0, -half, seat, roll=10))
    return union(*legs, box(width, width, 0.05).at(z=seat - 0.02), back)


def swivel_chair() -> Mesh:
    """Build a star foot, a column, a seat and a back."""
    spokes = [box(0.58, 0.05, 0.06).at(yaw=angle) for angle in (0, 60, 120)]
    back = box(0.42, 0.06, 0.5).placed(rigid(0, -0.22, 0.55, roll=8))
    return union(*spokes, cylinder(0.04, 0.45, sides=10), box(0.48, 0.48, 0.08).at(z=0.45), back)


def shelf(width: float = 0.9, depth: float = 0.35, height: float = 1.9, boards: int = 5) -> Mesh:
    """Build sides, a back, boards, and rows of books of different lengths on the boards."""
    side, thick = width / 2 - 0.012, 0.024
    parts = [box(thick, depth, height).at(sign * side) for sign in (-1, 1)]
    parts.append(box(width, 0.012, height).at(0, -depth / 2 + 0.006))
    for board in range(boards):
        z = 0.04 + board * (height - 0.08) / (boards - 1)
        parts.append(box(width - thick, depth, thick).at(z=z))
        if board < boards - 1:
            row = (width - 0.1) * (0.35 + 0.5 * ((board * 0.37) % 1.0))
            parts.append(box(row, depth * 0.6, 0.24).at(-width / 2 + 0.04 + row / 2, -0.03, z + thick))
    return union(*parts)


def cabinet(width: float = 0.8, depth: float = 0.42, height: float = 1.2) -> Mesh:
    """Build a closed box on a plinth with two doors and handles."""
    doors = [box(width / 2 - 0.02, 0.02, height - 0.14).at(s * width / 4, depth / 2, 0.1) for s in (-1, 1)]
    handles = [box(0.02, 0.04, 0.18).at(s * 0.05, depth / 2 + 0.03, height * 0.55) for s in (-1, 1)]
    body = box(width, depth, height - 0.06).at(z=0.06)
    return union(box(width - 0.06, depth - 0.06, 0.08), body, *doors, *handles)


def sofa(width: float = 1.8, depth: float = 0.8) -> Mesh:
    """Build a seat, arms and a leaning back."""
    arms = [box(0.18, depth, 0.58).at(sign * (width / 2 - 0.09)) for sign in (-1, 1)]
    back = box(width - 0.36, 0.18, 0.5).placed(rigid(0, -depth / 2 + 0.2, 0.34, roll=12))
    return union(box(width - 0.3, depth - 0.05, 0.42), *arms, back)


def bed(width: float = 1.4, length: float = 2.0) -> Mesh:
    """Build a mattress on a box, a headboard at its back, and two pillows."""
    board = box(width + 0.1, 0.06, 1.0).at(y=-length / 2 - 0.03)
    pillows = [box(0.55, 0.35, 0.12).at(sign * width / 4, -length / 2 + 0.25, 0.5) for sign in (-1, 1)]
    return union(box(width - 0.1, length - 0.1, 0.28), box(width, length, 0.22).at(z=0.28), board, *pillows)


def plant(height: float = 1.3) -> Mesh:
    """Build a conical pot, a stem and three balls of leaves."""
    pot = turned([(0.0, 0.0), (0.14, 0.0), (0.19, 0.32), (0.0, 0.32)])
    balls = [
        sphere(0.24).at(0.05, 0.0, height - 0.48),
        sphere(0.18).at(-0.14, 0.08, height - 0.66),
        sphere(0.16).at(0.04, -0.14, height - 0.78),
    ]
    return union(pot, cylinder(0.025, height - 0.3, sides=8), *balls)


def bin_(radius: float = 0.16, height: float = 0.42) -> Mesh:
    """Build a paper bin, wider at the top."""
    return turned([(0.0, 0.0), (radius * 0.8, 0.0), (radius, height), (0.0, height - 0.03)])


def crate(width: float = 0.5, depth: float = 0.4, height: float = 0.4) -> Mesh:
    """Build a cardboard box with a second, smaller one turned on top."""
    return union(box(width, depth, height), box(width * 0.6, depth * 0.6, height * 0.5).at(z=height, yaw=15))


def carton(width: float = 0.5, depth: float = 0.5, height: float = 0.5) -> Mesh:
    """Build one plain box."""
    return box(width, depth, height)


def trolley(width: float = 0.5, depth: float = 0.8) -> Mesh:
    """Build wheels, three trays and posts."""
    x, y = width / 2 - 0.03, depth / 2 - 0.03
    posts = [cylinder(0.015, 0.95, sides=8).at(sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1)]
    trays = [box(width, depth, 0.04).at(z=z) for z in (0.15, 0.5, 0.85)]
    return union(*posts, *trays)


def bench(width: float = 1.5, depth: float = 0.38) -> Mesh:
    """Build slats on two cheeks."""
    slats = [box(width, depth / 3 - 0.02, 0.04).at(0, (row - 1) * depth / 3, 0.42) for row in range(3)]
    return union(*slats, *(box(0.06, depth, 0.42).at(sign * (width / 2 - 0.2)) for sign in (-1, 1)))


def ladder(height: float = 2.1, lean: float = 14.0) -> Mesh:
    """Build a ladder against the wall behind it, leaning by `lean` degrees."""
    rails = [box(0.05, 0.03, height).at(sign * 0.22) for sign in (-1, 1)]
    rungs = [box(0.44, 0.03, 0.03).at(z=z) for z in np.arange(0.25, height, 0.28)]
    leaning = union(*rails, *rungs).placed(rigid(roll=lean))
    low, high = leaning.bounds
    return leaning.at(y=-(low[1] + high[1]) / 2, z=-low[2])


def barrel(radius: float = 0.28, height: float = 0.88) -> Mesh:
    """Build a drum that bulges in the middle."""
    profile = [(0.0, 0.0), (radius * 0.9, 0.0), (radius, height / 2), (radius * 0.9, height), (0.0, height)]
    return turned(profile)


def extinguisher() -> Mesh:
    """Build a bottle with its neck, on a bracket that reaches the wall behind it."""
    bottle = turned([(0.0, 0.0), (0.08, 0.0), (0.08, 0.42), (0.03, 0.5), (0.03, 0.56), (0.0, 0.56)])
    return union(bottle, block((-0.05, -0.14, 0.2), (0.05, 0.0, 0.26)))


#: What stands with its back against a wall.
WALL_PIECES: dict[str, Callable[[], Mesh]] = {
    "desk": desk,
    "shelf": shelf,
    "cabinet": cabinet,
    "sofa": sofa,
    "ladder": ladder,
    "bench": bench,
}

#: What stands anywhere.
FREE_PIECES: dict[str, Callable[[], Mesh]] = {
    "table": table,
    "chair": chair,
    "swivel-chair": swivel_chair,
    "plant": plant,
    "bin": bin_,
    "crate": crate,
    "carton": carton,
    "trolley": trolley,
    "barrel": barrel,
}
