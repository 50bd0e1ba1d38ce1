"""How far inside the image's border a detector's edges still are edges of the image and not of the object.

    ./calibslam shell -c 'python test/benchmarks/border_edges.py BAG...'

BAG as for `fit_calibrator`. Its reference boxes are fitted as if only edges on the border were those of the image; of
the other edges, by their distance from the border in stated standard deviations (2 px + 4 % of the extent): how many
there are, their mean error, negative inside, and how many are off by more than three deviations.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from calibslam_backend.geometry import box_measurement
from calibslam_backend.reference_boxes import ReferenceSettings, of_recording

DISTANCES = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 10.0, np.inf)
OUTWARDS = np.array([-1.0, -1.0, 1.0, 1.0])
GROSS = 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG")
    box_measurement.BORDER_SIGMAS = 0.0
    settings = ReferenceSettings()
    for bag in parser.parse_args().bags:
        errors, distances = [], []
        for image in of_recording(bag):
            stated = np.sqrt(settings.stated_variances(image.boxes.corners))
            known = np.isfinite(image.errors)
            errors.append((OUTWARDS * image.errors / stated)[known])
            distances.append((image.boxes.to_border / stated)[known])
        error, distance = np.concatenate(errors), np.concatenate(distances)
        print(f"{bag.name}: {len(error)} edges")
        for low, high in pairwise(DISTANCES):
            chosen = error[(distance > low) & (distance <= high)]
            if len(chosen):
                gross = np.mean(np.abs(chosen) > GROSS)
                print(f"  {low:4g} to {high:4g}: {len(chosen):6d}, mean {chosen.mean():+.2f}, gross {gross:5.1%}")


if __name__ == "__main__":
    main()
