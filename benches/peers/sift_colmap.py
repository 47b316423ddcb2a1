#!/usr/bin/env python3
"""COLMAP's SIFT (through pycolmap, CPU) of all images of a folder, for comparison with ours.

usage: sift_colmap.py IMAGES OUT [--first-octave -1] [--max-features 8192] [--threads 1]

Prints CPU-seconds per image, reading included, and writes OUT/NAME.sift: the number of features in 64 bits, x, y, scale and
orientation of each in 32-bit floating point, then 128 bytes of descriptor each.
"""
import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap


def cpu_s():
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def four_columns(keypoints):
    """x, y, scale, orientation of keypoints with affine shapes."""
    if keypoints.shape[1] == 4:
        return keypoints
    x, y, a11, a12, a21, a22 = keypoints.T[:6]
    scale = 0.5 * (np.hypot(a11, a21) + np.hypot(a12, a22))
    return np.stack([x, y, scale, np.arctan2(a21, a11)], axis=1)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("images", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--first-octave", type=int, default=-1)
    parser.add_argument("--max-features", type=int, default=8192)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    arguments.out.mkdir(parents=True, exist_ok=True)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.max_image_size = -1
    options.num_threads = arguments.threads
    options.sift.max_num_features = arguments.max_features
    options.sift.first_octave = arguments.first_octave
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        start, started = cpu_s(), time.time()
        pycolmap.extract_features(database, arguments.images, camera_mode=pycolmap.CameraMode.AUTO, extraction_options=options)
        cpu, wall = cpu_s() - start, time.time() - started
        total = 0
        with pycolmap.Database.open(database) as db:
            images = db.read_all_images()
            for image in images:
                keypoints = four_columns(np.asarray(db.read_keypoints(image.image_id), dtype=np.float32))
                descriptors = db.read_descriptors(image.image_id)
                descriptors = np.asarray(getattr(descriptors, "data", descriptors))
                total += len(keypoints)
                name = arguments.out / (image.name.replace("/", "_") + ".sift")
                with open(name, "wb") as file:
                    file.write(np.uint64(len(keypoints)).tobytes())
                    file.write(np.ascontiguousarray(keypoints, dtype="<f4").tobytes())
                    file.write(np.ascontiguousarray(descriptors, dtype=np.uint8).tobytes())
    count = max(len(images), 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{count} images: {cpu / count:.3f} CPU-s, {wall / count:.3f} wall-s, {total / count:.0f} features an image, peak {peak:.0f} MiB")


if __name__ == "__main__":
    main()
