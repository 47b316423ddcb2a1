#!/usr/bin/env python3
"""What COLMAP's verification kept: the points of every pair's inliers, from a database that COLMAP has filled.

usage: colmap_inliers.py DATABASE

Prints one JSON object: `pairs`, each the names of both images and a list of numbers, four for an inlier: x and y in the first image, x and y
in the second, in pixels (the centre of the first pixel is 0.5, 0.5).
"""
import json, sys

import numpy as np
import pycolmap


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    pairs = []
    with pycolmap.Database.open(sys.argv[1]) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        points = {number: np.asarray(database.read_keypoints(number))[:, :2] for number in names}
        for pair_id, geometry in zip(*database.read_two_view_geometries()):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            inliers = np.asarray(geometry.inlier_matches).reshape(-1, 2)
            both = np.hstack([points[first][inliers[:, 0]], points[second][inliers[:, 1]]])
            pairs.append([names[first], names[second], both.astype(float).round(3).ravel().tolist()])
    print(json.dumps(dict(pairs=pairs)))


if __name__ == "__main__":
    main()
