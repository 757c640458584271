"""Define the verbs of ``gen-dataset``: `VERBS` describes them and names the functions that run them."""

from __future__ import annotations

from dataclasses import replace

from unprocess_gen.cli.arguments import SOURCE, Argument, Place, Verb

DARK_FRAMES = Argument(
    ("--dark-frames", "noise.dark_frames"),
    "folder of the dark frames, if it is not the recorded one",
    "FOLDER",
    completes="folders",
)
DARK_SHADING = Argument(
    ("--dark-shading", "noise.dark_shading"),
    "dark-shading map, or folder of maps, if it is not the recorded one",
    "PATH",
    completes="files",
)
DATASET = Place("DIR", "the folder of a dataset")
KEYS = Argument(
    ("--keys",), "rows by source index, range or key, such as 3,7-9,00000012-p0007", "KEYS", expected="keys"
)


def _count(text: str) -> int:
    if (number := int(text)) < 0:
        raise ValueError
    return number


def _positive(text: str) -> int:
    if (number := int(text)) < 1:
        raise ValueError
    return number


def _whole_number(names: tuple[str, ...], text: str, metavar: str = "N") -> Argument:
    return Argument(names, text, metavar, int, "an integer")


def _local_path(text: str) -> str:
    if "://" in text:  # it would become a folder named after the scheme
        raise ValueError
    return text


def _to(text: str, metavar: str, *, required: bool = False) -> Argument:
    kind = metavar.lower()
    return Argument(("--to",), text, metavar, _local_path, f"a local {kind}", f"{kind}s", required)


PREPARED = Place("OUT", "the folder of a prepared run")
PART = Argument(("part",), "number of the part, from 0", "K", _count, "an integer of 0 or more")

SETTINGS_SOURCE = Argument(
    ("--source",), "folder of the photographs, or one photograph: source.root=ROOT", "ROOT", completes="files"
)

VERBS: dict[str, Verb] = {
    verb.name: verb
    for verb in (
        Verb(
            "generate",
            "generate a dataset; the default verb",
            "runs.generate",
            (SETTINGS_SOURCE,),
            composes=True,
            resumes=True,
        ),
        Verb(
            "prepare",
            "list the sources of a run and split it into parts, for separate jobs",
            "parts.prepare",
            (
                Argument(("parts",), "number of parts", "N", _positive, "an integer of 1 or more", required=True),
                SETTINGS_SOURCE,
            ),
            composes=True,
        ),
        Verb(
            "part",
            "generate part K (from 0) of a prepared run; default: that of the array job",
            "parts.part",
            (
                _whole_number(("n_jobs",), "number of worker processes; -1: all cores; default: as prepared"),
                Argument(
                    ("--source", "source.root"), "folder of the photographs on this host", "ROOT", completes="folders"
                ),
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
        Verb(
            "plan",
            "estimate pairs, bytes and time, and explain the effects; write nothing",
            "reports.plan",
            (Argument(("--all",), "read every photograph, for exact sizes"), SETTINGS_SOURCE),
            composes=True,
        ),
        Verb(
            "accuracy",
            "measure error and time of each tier; write a report; default out: accuracy",
            "reports.accuracy",
            (SETTINGS_SOURCE,),
            composes=True,
        ),
        Verb(
            "figures",
            "draw the article's figures for the first photograph; default out: figures",
            "reports.figures",
            (SETTINGS_SOURCE,),
            composes=True,
        ),
        Verb(
            "verify",
            "check every byte of a dataset or sweep; repair, regenerate, check noise",
            "checks.verify",
            (
                SOURCE,
                DARK_FRAMES,
                DARK_SHADING,
                Argument(
                    ("--regenerate",), "regenerate N pairs and compare them", "N", _count, "an integer of 0 or more"
                ),
                _to("with --noise: draw the fits in FILE (PNG)", "FILE"),
                Argument(("--repair",), "restore damaged files to the same bytes"),
                Argument(("--noise",), "check whether the noise in the arrays is that of the manifest"),
            ),
            Place("DIR", "the folder of a dataset or of a sweep"),
        ),
        Verb(
            "replay",
            "regenerate rows and compare them, or write their arrays",
            "checks.replay",
            (
                SOURCE,
                DARK_FRAMES,
                DARK_SHADING,
                Argument(("--rows",), "rows A to B by position, from 0, B not included", "A:B"),
                KEYS,
                _to("write the arrays to FOLDER", "FOLDER"),
            ),
            Place("MANIFEST", "a manifest.csv, or the folder of a dataset", "files"),
        ),
        Verb(
            "report",
            "write an HTML page about a dataset",
            "reports.report",
            (_to("write FILE instead of DIR/report.html", "FILE"), SOURCE, DARK_FRAMES, DARK_SHADING),
            DATASET,
        ),
        Verb(
            "preview",
            "draw contact sheets of pairs, and of each processing step",
            "reports.preview",
            (
                KEYS,
                _to("write the pictures to FOLDER", "FOLDER", required=True),
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
                _to("write the files to FOLDER", "FOLDER", required=True),
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
                SOURCE,
                DARK_FRAMES,
                DARK_SHADING,
                Argument(("out",), "folder of the new dataset", "FOLDER", completes="folders", required=True),
                _whole_number(("n_jobs",), "number of worker processes; -1: all cores"),
                Argument(("executor",), "what runs the workers: local or dask", "NAME"),
                Argument(("executor.address",), "address of a Dask scheduler", "ADDRESS"),
                _whole_number(("source.max_failed",), "largest number of failed sources with exit code 0"),
            ),
            DATASET,
            resumes=True,
        ),
        Verb(
            "completion",
            'print a completion script: eval "$(gen-dataset completion bash)"',
            "completion.completion",
            words=("bash", "zsh"),
        ),
    )
}
"""The verbs by name, in the order of the help."""
