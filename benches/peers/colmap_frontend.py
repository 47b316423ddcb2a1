#!/usr/bin/env python3
"""Run COLMAP's front end (through pycolmap, on CPUs) on a folder of photographs and print what it took and found.

usage: colmap_frontend.py IMAGES WORK [--first-octave N] [--max-features N] [--limit N] [--camera MODEL:p1,p2,...]
                          [--spatial N] [--extract-only] [--threads N]

WORK/database.db is left behind. Each stage runs in a child of its own, so that its CPU time and peak memory are the stage's. Prints one
JSON object: `extract` and `match` with wall_s, cpu_s, peak_mib; `images` with the number of features of each; `pairs` with the names
of both images, how many matches agree with their two-view geometry, and its kind; `pairs_tried`, with those that have no geometry.
"""
import argparse, json, multiprocessing, resource, shutil, sys, time
from pathlib import Path


def in_child(stage):
    """Run a function in a child process; returns what it took."""
    def child(queue):
        start = time.time()
        stage()
        used = resource.getrusage(resource.RUSAGE_SELF)
        queue.put(dict(wall_s=time.time() - start, cpu_s=used.ru_utime + used.ru_stime, peak_mib=used.ru_maxrss / 1024))
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    process = context.Process(target=child, args=(queue,))
    process.start()
    process.join(timeout=None)
    if process.exitcode != 0:
        sys.exit(f"a stage ended with {process.exitcode}")
    return queue.get()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("images", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--first-octave", type=int, default=-1)
    parser.add_argument("--max-features", type=int, default=8192)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--camera")
    parser.add_argument("--spatial", type=int)
    parser.add_argument("--extract-only", action="store_true")
    parser.add_argument("--threads", type=int, default=-1)
    args = parser.parse_args()
    import pycolmap
    pycolmap.logging.minloglevel = 2
    shutil.rmtree(args.work, ignore_errors=True)
    args.work.mkdir(parents=True)
    database = args.work / "database.db"
    endings = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}
    names = sorted(str(p.relative_to(args.images)) for p in args.images.rglob("*") if p.suffix.lower() in endings)
    names = names[: args.limit] if args.limit else names

    def extract():
        options = pycolmap.FeatureExtractionOptions()
        options.max_image_size = -1
        options.num_threads = args.threads
        options.use_gpu = False
        options.sift.max_num_features = args.max_features
        options.sift.first_octave = args.first_octave
        reader = pycolmap.ImageReaderOptions()
        if args.camera:
            reader.camera_model, reader.camera_params = args.camera.split(":")
        pycolmap.extract_features(database, args.images, image_names=names, camera_mode=pycolmap.CameraMode.AUTO,
                                  reader_options=reader, extraction_options=options)

    def match():
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads = args.threads
        options.use_gpu = False
        if args.spatial:
            pairing = pycolmap.SpatialPairingOptions()
            pairing.max_num_neighbors = args.spatial
            pairing.ignore_z = True
            pycolmap.match_spatial(database, matching_options=options, pairing_options=pairing)
        else:
            pycolmap.match_exhaustive(database, matching_options=options)

    result = dict(extract=in_child(extract))
    if not args.extract_only:
        result["match"] = in_child(match)
    with pycolmap.Database.open(database) as found:
        images = {image.image_id: image.name for image in found.read_all_images()}
        result["images"] = {name: found.num_keypoints_for_image(number) for number, name in images.items()}
        if not args.extract_only:
            result["pairs"] = pairs(pycolmap, found, images)
            result["pairs_tried"] = found.num_matched_image_pairs()
    print(json.dumps(result))


def pairs(pycolmap, found, images):
    """Every pair of the database with its counts."""
    rows = []
    ids, geometries = found.read_two_view_geometries()
    for pair_id, geometry in zip(ids, geometries):
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        inliers = len(geometry.inlier_matches)
        rows.append([images[first], images[second], inliers, str(geometry.config)])
    return rows


if __name__ == "__main__":
    main()
