"""Define the verbs of ``gen-dataset``, in the order of the help."""

from __future__ import annotations

from unprocess_gen.cli import cameras, checks, reports, runs
from unprocess_gen.cli.arguments import Operand, Verb, count, flag, local, switch

DATASET = Operand("DIR", "the folder of a dataset")
ANY_DATASET = Operand("DIR", "the folder of a dataset or of a sweep")
BEGUN = Operand("OUT", "the folder of a run in parts")
N_JOBS = {"n_jobs=N": "number of worker processes; -1: all cores"}
SOURCE = {"source.root=ROOT": "folder of the photographs; by default the one recorded in dataset.json"}
INPUTS = SOURCE | {"noise.dark_frames=FOLDER": "folder of the dark frames, if it is not the recorded one"}
"""Where the files are that pairs are regenerated from."""

ROWS = "rows by source index, range or key, such as 3,7-9,00000012-p0007"
KEYS = flag("--keys", "KEYS", ROWS)

_VERBS = (
    Verb("generate", "generate a dataset; the default verb", runs.generate, composes=True),
    Verb("manifest", "write the manifest of a dataset without frames, for ug.LivePairs", runs.manifest, composes=True),
    Verb(
        "part",
        "generate part K (from 0) of N of a dataset, for separate jobs; merge finishes it",
        runs.part,
        Operand("K/N", "part K (from 0) of N; or /N in a job of an array"),
        composes=True,
    ),
    Verb("merge", "write manifest.csv and dataset.json when all parts are finished", runs.merge, BEGUN),
    Verb(
        "plan",
        "estimate pairs, bytes and time, and explain the effects; write nothing",
        reports.plan,
        flags=(
            switch("--all", "read every photograph, and name those that fail"),
            switch("--numbers", "state the source of each number of the noise profile"),
        ),
        composes=True,
    ),
    Verb("accuracy", "measure time and error of each tier; default out: accuracy", reports.accuracy, composes=True),
    Verb(
        "verify",
        "check every byte of a dataset or sweep; repair, regenerate, check noise",
        checks.verify,
        ANY_DATASET,
        (
            flag("--regenerate", "N", "regenerate N pairs and compare them", count),
            switch("--repair", "restore damaged files to the same bytes"),
            switch("--noise", "check whether the noise in the arrays is that of the manifest"),
            flag("--against", "FRAMES", "compare raw darks and flats of a camera with the noise profile", local),
        ),
        INPUTS,
    ),
    Verb(
        "replay",
        "regenerate rows and compare them, or write their arrays",
        checks.replay,
        Operand("MANIFEST", "a manifest.csv, or the folder of a dataset"),
        (KEYS, flag("--to", "FOLDER", "write the arrays to FOLDER", local)),
        INPUTS,
    ),
    Verb(
        "report",
        "write an HTML page about a dataset or a sweep",
        reports.report,
        ANY_DATASET,
        (flag("--to", "FILE", "write FILE instead of DIR/report.html", local),),
        INPUTS,
    ),
    Verb(
        "explore",
        "try settings on a photograph or a row, in a page of the browser on this machine",
        reports.explore,
        Operand("PHOTO", "a photograph, a folder of photographs, or a dataset", optional=True),
        (
            KEYS,
            flag("--port", "N", "number of the port on 127.0.0.1; default: a free one", count, default=0),
            switch("--no-browser", "print the address, and open no browser"),
        ),
        composes=True,
    ),
    Verb(
        "preview",
        "draw contact sheets of pairs, and of each processing step",
        reports.preview,
        DATASET,
        (
            KEYS,
            flag("--to", "FOLDER", "write the pictures to FOLDER", local, required=True),
            switch("--stages", "draw each processing step too"),
        ),
        SOURCE,
    ),
    Verb(
        "dng",
        "write frames as DNG files, for raw converters",
        reports.dng,
        DATASET,
        (
            flag("--keys", "KEYS", ROWS, required=True),
            flag("--to", "FOLDER", "write the files to FOLDER", local, required=True),
            switch("--noisy", "only noisy frames"),
            switch("--clean", "only clean frames"),
        ),
    ),
    Verb(
        "again",
        "regenerate a dataset from its config.yaml in another folder, and compare",
        runs.again,
        DATASET,
        keys={
            "out=FOLDER": "folder of the new dataset (required)",
            **INPUTS,
            **N_JOBS,
            "executor=NAME": "what runs the workers: local or dask",
            "executor.address=ADDRESS": "address of a Dask scheduler",
            "executor.no_workers_s=SECONDS": "time without any worker after which the run ends",
            "output.frames=true": "make the frames of a manifest without frames",
            "source.max_failed=N": "largest number of failed sources with exit code 0",
        },
    ),
    Verb(
        "build",
        "make a benchmark build and compare every byte with its recorded digests",
        runs.build,
        Operand("NAME", "the name of a build", optional=True),
        (flag("--to", "DIR", "write the build to DIR", local), switch("--list", "list all builds")),
        N_JOBS,
    ),
    Verb(
        "calibrate",
        "measure the noise of a camera from raw frames, or read it from DNG files; write a noise profile",
        cameras.calibrate,
        Operand("CAPTURES", "the folder of the raw frames, or with --from noise_profile of DNG files"),
        (
            flag("--to", "FILE", "write the profile to FILE.yaml, and estimates to FILE.json", local, required=True),
            flag("--report", "PAGE", "draw curves, histograms and maps in PAGE (HTML)", local),
            flag("--from", "noise_profile", "read tags of DNG files", dest="origin", choices=("noise_profile",)),
        ),
    ),
    Verb(
        "camera",
        "write a camera option, and a sensor option, from one raw file",
        cameras.camera,
        Operand("FILE", "the raw file: a DNG, or another one that LibRaw reads"),
        (
            flag("--to", "CAMERA", "write the matrix of the camera to CAMERA.yaml", local, required=True),
            flag("--sensor", "SENSOR", "write pattern, bits and levels to SENSOR.yaml", local),
        ),
    ),
)

VERBS: dict[str, Verb] = {verb.name: verb for verb in _VERBS}
"""The verbs by name."""
