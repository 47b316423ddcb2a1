#!/usr/bin/env python3
"""Map a COLMAP database with COLMAP's own mappers (pycolmap) and print what came out of each.

usage: colmap_map.py DATABASE IMAGES WORK [--mapper incremental|global ...] [--evaluate EVALUATE.py --truth FLAG=VALUE]

The database is copied, because COLMAP changes what it opens. Each mapper's largest model is left in WORK/MAPPER/best. With
--evaluate, that script judges each model: --truth gt-strecha=DIR becomes `EVALUATE.py WORK/MAPPER/best --gt-strecha DIR`.
"""
import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path


def describe(database):
    """How much a database holds, by COLMAP's own count: shows that it can be opened."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        return dict(
            cameras=opened.num_cameras(),
            images=opened.num_images(),
            keypoints=opened.num_keypoints(),
            pairs=opened.num_verified_image_pairs(),
            inliers=opened.num_inlier_matches(),
        )


def run(mapper, database, images, out):
    """Runs one mapper with its default options; the largest model."""
    import pycolmap

    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    function = dict(incremental=pycolmap.incremental_mapping, **{"global": pycolmap.global_mapping})[mapper]
    models = function(database, images, out)
    if not models:
        return None
    best = max(models.values(), key=lambda model: model.num_reg_images())
    (out / "best").mkdir()
    best.write(out / "best")
    return dict(
        models=len(models),
        registered=best.num_reg_images(),
        points=best.num_points3D(),
        track=round(best.compute_mean_track_length(), 2),
        reprojection_px=round(best.compute_mean_reprojection_error(), 3),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("database", type=Path)
    parser.add_argument("images", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--mapper", nargs="*", default=["incremental", "global"])
    parser.add_argument("--evaluate", type=Path)
    parser.add_argument("--truth")
    a = parser.parse_args()
    try:
        import pycolmap
    except ImportError:
        sys.exit("pycolmap is not there: pip install pycolmap==4.2.1 numpy")
    pycolmap.logging.minloglevel = 2
    a.work.mkdir(parents=True, exist_ok=True)
    database = a.work / "database.db"
    shutil.copyfile(a.database, database)
    print(json.dumps(dict(database=str(a.database), **describe(database))), flush=True)
    for mapper in a.mapper:
        wall, cpu = time.time(), resource.getrusage(resource.RUSAGE_SELF).ru_utime
        out = a.work / mapper
        model = run(mapper, database, a.images, out)
        row = dict(mapper=mapper, wall_s=round(time.time() - wall, 1))
        row["cpu_s"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_utime - cpu, 1)
        row |= model or dict(registered=0)
        if model and a.evaluate and a.truth:
            flag, value = a.truth.split("=", 1)
            command = [sys.executable, str(a.evaluate), str(out / "best"), f"--{flag}", value]
            row |= json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
