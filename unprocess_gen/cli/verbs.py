"""Define the verbs of ``gen-dataset``: `VERBS` describes them and names the functions that run them."""

from __future__ import annotations

from dataclasses import replace

from unprocess_gen.cli.arguments import Argument, PlaceArgument, Verb, choice


def _integer(name: str, text: str, low: int | None = None, metavar: str = "N", *, required: bool = False) -> Argument:
    """Return an argument that is an integer, of ``low`` or more."""

    def read(written: str) -> int:
        number = int(written)
        if low is not None and number < low:
            raise ValueError
        return number

    expected = "an integer" if low is None else f"an integer of {low} or more"
    return Argument((name,), text, metavar, read, expected, required=required)


def _local_path(text: str) -> str:
    if "://" in text:  # it would become a folder named after the scheme
        raise ValueError
    return text


def _file(flag: str, text: str, metavar: str = "FILE", *, required: bool = False) -> Argument:
    return Argument((flag,), text, metavar, _local_path, "a local file", required)


def _folder(flag: str, text: str, metavar: str = "FOLDER", *, required: bool = False) -> Argument:
    return Argument((flag,), text, metavar, _local_path, "a local folder", required)


def _composing(name: str, summary: str, run: str, *arguments: Argument, resumes: bool = False) -> Verb:
    """Return a verb that takes the settings of a run."""
    return Verb(name, summary, run, arguments, composes=True, resumes=resumes)


PARTS = _integer("parts", "number of parts", 1, required=True)
PREPARED = PlaceArgument("OUT", "the folder of a prepared run")
PART = _integer("part", "number of the part, from 0", 0, "K")
DATASET = PlaceArgument("DIR", "the folder of a dataset")
KEYS = Argument(
    ("--keys",), "rows by source index, range or key, such as 3,7-9,00000012-p0007", "KEYS", expected="keys"
)
REGENERATE = _integer("--regenerate", "regenerate N pairs and compare them", 0)
OUT = Argument(("out",), "folder of the new dataset", "FOLDER", required=True)
SOURCE = Argument(("source.root",), "folder of the photographs; by default the one recorded in dataset.json", "ROOT")
INPUTS = (
    SOURCE,
    Argument(("noise.dark_frames",), "folder of the dark frames, if it is not the recorded one", "FOLDER"),
)
"""Where the files are that pairs are regenerated from."""

_VERBS = (
    _composing("generate", "generate a dataset; the default verb", "runs.generate", resumes=True),
    _composing(
        "manifest",
        "write the manifest of a dataset without its frames, for ug.LivePairs",
        "runs.manifest",
        resumes=True,
    ),
    _composing(
        "prepare", "list the sources of a run and split it into parts, for separate jobs", "parts.prepare", PARTS
    ),
    Verb(
        "part",
        "generate part K (from 0) of a prepared run; default: that of the array job",
        "parts.part",
        (
            _integer("n_jobs", "number of worker processes; -1: all cores; default: as prepared"),
            replace(SOURCE, help="folder of the photographs on this host"),
        ),
        PREPARED,
        extra=PART,
        resumes=True,
    ),
    Verb(
        "status",
        "show which parts of a prepared run are left",
        "parts.status",
        (Argument(("--left",), "print only the numbers of the parts that are left: 3,7-9"),),
        PREPARED,
    ),
    Verb("merge", "write manifest.csv and dataset.json when all parts are finished", "parts.merge", place=PREPARED),
    _composing(
        "plan",
        "estimate pairs, bytes and time, and explain the effects; write nothing",
        "reports.plan",
        Argument(("--all",), "read every photograph, and name those that fail"),
        Argument(("--numbers",), "state the source of each number of the noise profile"),
    ),
    _composing(
        "accuracy", "measure time and error of each tier, stage by stage; default out: accuracy", "reports.accuracy"
    ),
    Verb(
        "verify",
        "check every byte of a dataset or sweep; repair, regenerate, check noise",
        "checks.verify",
        (
            *INPUTS,
            REGENERATE,
            Argument(("--repair",), "restore damaged files to the same bytes"),
            Argument(("--noise",), "check whether the noise in the arrays is that of the manifest"),
            _folder("--against", "compare raw darks and flats of a camera with the noise profile", "FRAMES"),
        ),
        PlaceArgument("DIR", "the folder of a dataset or of a sweep"),
    ),
    Verb(
        "replay",
        "regenerate rows and compare them, or write their arrays",
        "checks.replay",
        (*INPUTS, KEYS, _folder("--to", "write the arrays to FOLDER")),
        PlaceArgument("MANIFEST", "a manifest.csv, or the folder of a dataset"),
    ),
    Verb(
        "report",
        "write an HTML page about a dataset or a sweep",
        "reports.report",
        (_file("--to", "write FILE instead of DIR/report.html"), *INPUTS),
        PlaceArgument("DIR", "the folder of a dataset or of a sweep"),
    ),
    Verb(
        "explore",
        "try settings on a photograph or a row, in a page of the browser on this machine",
        "explore.explore",
        (
            KEYS,
            _integer("--port", "number of the port on 127.0.0.1; default: a free one", 0),
            Argument(("--no-browser",), "print the address, and open no browser"),
        ),
        PlaceArgument("PHOTO", "a photograph, a folder of photographs, or a dataset", optional=True),
        composes=True,
    ),
    Verb(
        "preview",
        "draw contact sheets of pairs, and of each processing step",
        "reports.preview",
        (
            KEYS,
            _folder("--to", "write the pictures to FOLDER", required=True),
            SOURCE,
            Argument(("--stages",), "draw each processing step too"),
        ),
        DATASET,
    ),
    Verb(
        "dng",
        "write frames as DNG files, for raw converters",
        "reports.dng",
        (
            replace(KEYS, required=True),
            _folder("--to", "write the files to FOLDER", required=True),
            Argument(("--noisy",), "only noisy frames"),
            Argument(("--clean",), "only clean frames"),
        ),
        DATASET,
    ),
    Verb(
        "again",
        "regenerate a dataset from its config.yaml in another folder, and compare",
        "runs.again",
        (
            *INPUTS,
            OUT,
            _integer("n_jobs", "number of worker processes; -1: all cores"),
            Argument(("executor",), "what runs the workers: local or dask", "NAME"),
            choice(("output.frames",), "make the frames of a manifest without frames", "true"),
            Argument(("executor.address",), "address of a Dask scheduler", "ADDRESS"),
            _integer("source.max_failed", "largest number of failed sources with exit code 0"),
        ),
        DATASET,
        resumes=True,
    ),
    Verb(
        "build",
        "make a benchmark build and compare every byte with its recorded digests",
        "builds.build",
        (
            _folder("--to", "write the build to DIR", "DIR"),
            Argument(("--list",), "list all builds"),
            _integer("n_jobs", "number of worker processes; -1: all cores"),
        ),
        extra=Argument(("name",), "name of the build", "NAME"),
        resumes=True,
    ),
    Verb(
        "calibrate",
        "measure the noise of a camera from raw frames, or read it from DNG files; write a noise profile",
        "calibration.calibrate",
        (
            _file("--to", "write the profile to FILE.yaml, and all estimates to FILE.json", required=True),
            _file("--report", "draw curves, histograms and maps in PAGE (HTML)", "PAGE"),
            choice(("--from",), "make the profile from NoiseProfile tags of DNG files", "noise_profile"),
        ),
        PlaceArgument("CAPTURES", "the folder of the raw frames, or with --from noise_profile of DNG files"),
    ),
    Verb(
        "camera",
        "write a camera option, and a sensor option, from one raw file",
        "camera.camera",
        (
            _file("--to", "write the matrix of the camera to CAMERA.yaml", "CAMERA", required=True),
            _file("--sensor", "write pattern, bits and levels to SENSOR.yaml", "SENSOR"),
        ),
        PlaceArgument("FILE", "the raw file: a DNG, or another one that LibRaw reads"),
    ),
)

VERBS: dict[str, Verb] = {verb.name: verb for verb in _VERBS}
"""The verbs by name, in the order of the help."""
