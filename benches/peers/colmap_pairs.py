#!/usr/bin/env python3
"""The pairs of photographs that COLMAP verifies (pycolmap, CPU), as the truth that retrieval is measured against.

usage: colmap_pairs.py IMAGES DATABASE OUT [--neighbours N] [--min-inliers N] [--threads N]

Features and matches are kept in DATABASE: a run that was stopped goes on where it was, a second one only reads. Photographs with GPS are matched with
their N nearest (as the crow flies, heights ignored), those without with all. OUT gets a line for each verified pair:
two names and the number of inliers, tab-separated, most inliers first.
"""
import argparse
from pathlib import Path

import pycolmap


def build(arguments):
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = 8192
    extraction.num_threads = arguments.threads
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = arguments.threads
    pycolmap.extract_features(arguments.database, arguments.images, camera_mode=pycolmap.CameraMode.SINGLE,
                              extraction_options=extraction)
    if arguments.neighbours:
        pairing = pycolmap.SpatialPairingOptions()
        pairing.max_num_neighbors = arguments.neighbours
        pairing.ignore_z = True
        pycolmap.match_spatial(arguments.database, matching_options=matching, pairing_options=pairing)
    else:
        pycolmap.match_exhaustive(arguments.database, matching_options=matching)


def verified(arguments):
    with pycolmap.Database.open(arguments.database) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        ids, geometries = database.read_two_view_geometries()
        rows = []
        for pair_id, geometry in zip(ids, geometries):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            inliers = len(geometry.inlier_matches)
            if inliers >= arguments.min_inliers:
                rows.append((names[first], names[second], inliers))
    return sorted(rows, key=lambda row: (-row[2], row[0], row[1]))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", type=Path)
    parser.add_argument("database", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--neighbours", type=int, default=0, help="spatial neighbours; 0 matches every pair")
    parser.add_argument("--min-inliers", type=int, default=15)
    parser.add_argument("--threads", type=int, default=-1)
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    done = arguments.database.with_suffix(".done")
    if not done.exists():
        build(arguments)
        done.touch()
    rows = verified(arguments)
    arguments.out.write_text("".join(f"{a}\t{b}\t{inliers}\n" for a, b, inliers in rows))
    print(f"{len(rows)} verified pairs")


if __name__ == "__main__":
    main()
