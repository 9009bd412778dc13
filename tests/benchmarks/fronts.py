"""Where pictures take the front of a body to be (`upright`), against its hips, shoulders and waist.

    SCAPEKIT_DATA=... python tests/benchmarks/fronts.py [-o FILE]

All SCAPE poses and SPRING men, as surfaces and as points without triangles. True is the level direction that is square
to the lines from right to left between landmarks.
"""
from __future__ import annotations

import argparse

import numpy as np
from protocols import RealData, load_real, machine, write_report

from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import guess_upright

UP = 2
WRONG = 60.0                         # degrees: the picture is not one of the front any more
PAIRS = (("hip, right", "hip, left"), ("shoulder (upper) right side", "shoulder (upper) left side"),
         ("waist right side", "waist left side"))


def true_front(body: Mesh, landmarks: dict[str, int]) -> float:
    """Azimuth, degrees, of the direction in which a body looks."""
    to_left = sum(body.vertices[landmarks[left]] - body.vertices[landmarks[right]] for right, left in PAIRS)
    ahead = np.cross(to_left, np.eye(3)[UP])
    return float(np.degrees(np.arctan2(ahead[1], ahead[0])))


def off(body: Mesh, landmarks: dict[str, int], points: bool) -> float:
    """Degrees between the front and where it is taken to be; 180 where another axis is taken for up."""
    up, front = guess_upright(Mesh(body.vertices, np.zeros((0, 3), dtype=np.int64)) if points else body)
    apart = abs((front - true_front(body, landmarks) + 180) % 360 - 180)
    return apart if up == UP else 180.0


def measure(data: RealData, bodies: np.ndarray, name: str, points: bool) -> dict[str, object]:
    """A row of the table."""
    apart = np.array([off(data.template.with_vertices(v), data.landmarks, points) for v in bodies])
    return {"bodies": name, "given": "points" if points else "surface", "count": len(apart),
            "median": float(np.median(apart)), "beyond_30": int((apart > 30).sum()),
            "beyond_60": int((apart > WRONG).sum()), "which": np.flatnonzero(apart > WRONG).tolist()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    data = load_real()
    rows = [measure(data, bodies, name, points) for points in (False, True)
            for name, bodies in (("SCAPE poses", data.poses), ("SPRING men", data.shapes))]
    for row in rows:
        print(row)
    if args.output:
        write_report(args.output, {"machine": machine(), "rows": rows})


if __name__ == "__main__":
    main()
