#!/usr/bin/env python3
"""Inliers and time of COLMAP's two-view geometry, pair by pair, beside terrane's.

usage: colmap_verification.py EXPORT [--repeats N]
       colmap_verification.py EXPORT --images FOLDER --work FOLDER [--camera MODEL:params]

EXPORT is what `cargo run --release --example verification -- --export EXPORT ...` wrote. The first form gives COLMAP the
same keypoints, matches and cameras that terrane had, so that both verify equal input. The second lets COLMAP extract and
match by itself (8,192 features, first octave -1, its defaults) and compares what it verifies of the same pairs.
"""
import argparse
import resource
import time
from pathlib import Path

import numpy as np
import pycolmap


MODELS = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"]


def read_export(folder):
    cameras, keypoints = {}, {}
    for line in (folder / "cameras.txt").read_text().splitlines():
        # A name may hold spaces; models may not.
        words = line.split(" ")
        at = next(k for k, word in enumerate(words) if word in MODELS and k > 0)
        name, (model, width, height, trusted, *params) = " ".join(words[:at]), words[at:]
        camera = pycolmap.Camera(model=model, width=int(width), height=int(height), params=[float(p) for p in params])
        camera.has_prior_focal_length = trusted == "1"
        cameras[name] = camera
        text = (folder / f"{name}.keypoints").read_text()
        keypoints[name] = np.array(text.split(), float).reshape(-1, 2)
    pairs = []
    for block in (folder / "matches.txt").read_text().strip().split("\n\n"):
        names, *rows = block.split("\n")
        first, second = names.split(" ")
        rows = np.array([row.split(" ") for row in rows], dtype=np.uint32).reshape(-1, 3)
        pairs.append((first, second, rows[:, :2], int(rows[:, 2].sum())))
    times = {}
    for line in (folder / "pairs.txt").read_text().splitlines():
        first, second, _, _, kind, milliseconds = line.split(" ")
        times[first, second] = (kind, float(milliseconds))
    return cameras, keypoints, pairs, times


def verify(cameras, keypoints, pairs, repeats):
    """(inliers, configuration, milliseconds of CPU) of each pair."""
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    results = []
    for first, second, matches, _ in pairs:
        best = float("inf")
        for _ in range(repeats):
            start = time.process_time()
            geometry = pycolmap.estimate_two_view_geometry(
                cameras[first], keypoints[first], cameras[second], keypoints[second], matches, options)
            best = min(best, (time.process_time() - start) * 1e3)
        results.append((len(geometry.inlier_matches), str(geometry.config), best))
    return results


def own_features(images, work, camera, names):
    """COLMAP's own inliers of each pair of names, from a database that it fills."""
    work.mkdir(parents=True, exist_ok=True)
    database = work / "database.db"
    if not database.exists():
        reader = pycolmap.ImageReaderOptions()
        if camera:
            reader.camera_model, reader.camera_params = camera.split(":")
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.use_gpu = False
        start = resource.getrusage(resource.RUSAGE_SELF)
        pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
                                  extraction_options=extraction, device=pycolmap.Device.cpu)
        middle = resource.getrusage(resource.RUSAGE_SELF)
        with (work / "pairs.txt").open("w") as file:
            file.writelines(f"{first} {second}\n" for first, second in names)
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(work / "pairs.txt")
        pycolmap.match_image_pairs(database, pairing_options=pairing, device=pycolmap.Device.cpu)
        end = resource.getrusage(resource.RUSAGE_SELF)
        print(f"COLMAP: extraction {middle.ru_utime - start.ru_utime:.1f} CPU-s, matching and verification "
              f"{(end.ru_utime - middle.ru_utime) / max(len(names), 1):.3f} CPU-s a pair")
    opened = pycolmap.Database.open(database)
    id_of = {image.name: image.image_id for image in opened.read_all_images()}
    inliers = []
    for first, second in names:
        known = opened.exists_two_view_geometry(id_of[first], id_of[second]) if first in id_of and second in id_of else False
        geometry = opened.read_two_view_geometry(id_of[first], id_of[second]) if known else None
        inliers.append(len(geometry.inlier_matches) if geometry else 0)
    return inliers


def compare(title, pairs, theirs, least=15):
    ours = np.array([pair[3] for pair in pairs], float)
    theirs = np.array(theirs, float)
    real = (ours >= least) & (theirs >= least)
    ratio = ours[real] / theirs[real]
    print(f"{title}: pairs verified by terrane {int((ours >= least).sum())}, by COLMAP {int((theirs >= least).sum())}, by both {int(real.sum())}")
    if real.any():
        print(f"  inliers of pairs that both verify: terrane median {np.median(ours[real]):.0f}, COLMAP {np.median(theirs[real]):.0f}; "
              f"sum {ours[real].sum():.0f} / {theirs[real].sum():.0f} = {ours[real].sum() / theirs[real].sum():.3f}; "
              f"ratio a pair: 5 % {np.quantile(ratio, 0.05):.3f}, median {np.median(ratio):.3f}, 95 % {np.quantile(ratio, 0.95):.3f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("export", type=Path)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--camera")
    parser.add_argument("--pairs", action="store_true", help="list every pair")
    arguments = parser.parse_args()
    cameras, keypoints, pairs, times = read_export(arguments.export)
    results = verify(cameras, keypoints, pairs, arguments.repeats)
    if arguments.pairs:
        for (first, second, matches, ours), (theirs, config, milliseconds) in zip(pairs, results):
            kind, own = times[first, second]
            print(f"{first} {second} matches {len(matches)} terrane {ours} {kind} {own:.2f} ms, COLMAP {theirs} {config} {milliseconds:.2f} ms")
    compare("equal matches", pairs, [result[0] for result in results])
    real = [k for k, pair in enumerate(pairs) if pair[3] >= 15 and results[k][0] >= 15]
    if real:
        own = [times[pairs[k][0], pairs[k][1]][1] for k in real]
        print(f"  time of verification, ms, median: terrane {np.median(own):.2f}, COLMAP {np.median([results[k][2] for k in real]):.2f}")
    if arguments.images:
        names = [(first, second) for first, second, _, _ in pairs]
        compare("own features", pairs, own_features(arguments.images, arguments.work, arguments.camera, names))


if __name__ == "__main__":
    main()
