"""Complete command lines in bash and zsh: verbs, flags, settings and options.

``gen-dataset completion bash`` prints a script. Its function calls ``gen-dataset completion query LINE`` with the line
up to the cursor. The query prints the kind of completion (``words``, ``folders``, ``files``) and the candidates. The
script for zsh calls ``describe`` instead of ``query``, since zsh can show a description next to each candidate.

Design: ``docs/design/command_line.md``.
"""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path

from unprocess_gen.cli.arguments import ANY_VALUE, HYDRA_FLAGS, STANDARD, Argument, Call, Verb
from unprocess_gen.config.limits import Boolean, Choice
from unprocess_gen.config.option_files import conf_dir, group_options, option_summary
from unprocess_gen.config.schema import GROUPS, Config, all_settings
from unprocess_gen.config.settings import settings_of
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.suggestions import did_you_mean

SHELLS = ("bash", "zsh")
QUERY, DESCRIBE = "query", "describe"
"""Words of the completion scripts, not for users: candidates alone, or each with a tab and its description."""

WORDS, FOLDERS, FILES = "words", "folders", "files"

BASH = r"""
_gen_dataset() {
    local IFS=$'\n' lines word=${COMP_WORDS[COMP_CWORD]}
    lines=($("$1" completion query "${COMP_LINE:0:COMP_POINT}" 2>/dev/null)) || return
    [[ $word == "=" ]] && word=
    case ${lines[0]} in
        folders) compopt -o filenames; COMPREPLY=($(compgen -d -- "$word")) ;;
        files) compopt -o filenames; COMPREPLY=($(compgen -f -- "$word")) ;;
        words)
            COMPREPLY=("${lines[@]:1}")
            if [[ $COMP_WORDBREAKS == *=* ]]; then  # bash replaces only what follows the last "="
                local typed=${COMP_LINE:0:COMP_POINT}
                typed=${typed##*[[:space:]]}
                if [[ $typed == *=* ]]; then COMPREPLY=("${COMPREPLY[@]#"${typed%=*}="}"); fi
            fi
            [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} == *[.=] ]] && compopt -o nospace ;;
    esac
    return 0
}
complete -F _gen_dataset gen-dataset
"""

ZSH = r"""
_gen_dataset() {
    local line word
    local -a lines closed closed_shown open open_shown
    lines=("${(@f)$("${words[1]}" completion describe "${(j: :)words[1,CURRENT-1]} $PREFIX" 2>/dev/null)}")
    case ${lines[1]} in
        folders) compset -P '*='; _files -/ ;;
        files) compset -P '*='; _files ;;
        words)
            for line in "${(@)lines[2,-1]}"; do
                word=${line%%$'\t'*}
                if [[ $word == *[.=] ]]; then
                    open+=("$word") open_shown+=("${line/$'\t'/  }")
                else
                    closed+=("$word") closed_shown+=("${line/$'\t'/  }")
                fi
            done
            (( $#closed )) && compadd -l -d closed_shown -- "${(@)closed}"
            (( $#open )) && compadd -l -S '' -d open_shown -- "${(@)open}" ;;
    esac
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }
compdef _gen_dataset gen-dataset
"""


def print_completion(call: Call, verbs: Mapping[str, Verb]) -> int:
    """Print the script of a shell, or the candidates for its query.

    Parameters
    ----------
    call : Call
        Parsed command line: the name of a shell, or a word of the scripts and the line up to the cursor.
    verbs : mapping of str to Verb
        The verbs by name.

    Returns
    -------
    int
        Exit code.

    Raises
    ------
    ConfigError
        If the shell is unknown.
    """
    words = call.words
    if len(words) == 2 and words[0] in (QUERY, DESCRIBE):
        kind, candidates = complete(words[1], verbs)
        if words[0] == DESCRIBE:
            candidates = [f"{candidate}\t{description(candidate, words[1], verbs)}" for candidate in candidates]
        print("\n".join([kind, *candidates]))
        return 0
    scripts = dict(zip(SHELLS, (BASH, ZSH), strict=True))
    if len(words) != 1 or words[0] not in scripts:
        word = " ".join(words)
        raise ConfigError(f"completion: {word or 'no shell'}: expected bash or zsh{did_you_mean(word, SHELLS)}")
    print(scripts[words[0]].lstrip("\n"), end="")
    return 0


def complete(line: str, verbs: Mapping[str, Verb]) -> tuple[str, list[str]]:
    """Return how the last word of a command line can be completed.

    Parameters
    ----------
    line : str
        The command line up to the cursor.
    verbs : mapping of str to Verb
        The verbs by name.

    Returns
    -------
    kind : str
        ``folders`` or ``files`` if the shell shall complete a name; else ``words``.
    candidates : list of str
        Complete words that begin with the last word of the line; for ``words`` only.
    """
    *before, current = _split(line)
    name = next(iter(before[1:2]), "")
    verb = verbs.get(name, verbs["generate"])
    arguments = (*verb.arguments, *STANDARD)
    last = before[-1] if len(before) > 1 else ""
    for argument in arguments:
        if argument.metavar and last in argument.flags:
            return argument.completes or WORDS, []
    for spellings, (values, _) in HYDRA_FLAGS.items() if verb.composes else ():
        if last in spellings and values:
            return (WORDS, _starting(current, values)) if values != ANY_VALUE else (FILES, [])
    if current.startswith("-"):
        return WORDS, _starting(current, _flags(verb, arguments, first=len(before) == 1))
    key, equals, _ = current.partition("=")
    for argument in arguments:
        if equals and key in argument.settings:
            return argument.completes or WORDS, []
    if equals and verb.composes:
        return _values(key, current, _option_folders(before))
    candidates = [f"{key}=" for argument in arguments for key in argument.settings]
    if len(before) == 1 and re.fullmatch("[a-z]*", current):
        candidates += verbs
    if verb.composes:
        candidates += _settings(current, _option_folders(before))
    candidates += verb.words
    found = _starting(current, candidates)
    if verb.place is not None and not found:
        return verb.place.completes, []
    if verb.place is not None and not current:
        return verb.place.completes, []
    return WORDS, found


def description(candidate: str, line: str, verbs: Mapping[str, Verb]) -> str:
    """Return what a candidate means, as ``--help`` explains it.

    Parameters
    ----------
    candidate : str
        A candidate of `complete` for this line.
    line : str
        The command line up to the cursor.
    verbs : mapping of str to Verb
        The verbs by name.

    Returns
    -------
    str
        One line; empty for candidates that need no explanation, such as the words of a setting.
    """
    before = _split(line)[:-1]
    name = next(iter(before[1:2]), "")
    verb = verbs.get(name, verbs["generate"])
    if candidate in verbs and len(before) == 1:
        return verbs[candidate].summary
    for argument in (*verb.arguments, *STANDARD):
        if candidate in argument.flags or candidate.removesuffix("=") in argument.settings:
            return argument.help
    for spellings, (_, text) in HYDRA_FLAGS.items():
        if candidate in spellings:
            return text
    key, _, value = candidate.lstrip("+").partition("=")
    option = value.rpartition(",")[2]
    for folder in _option_folders(before):
        if (folder / key / f"{option}.yaml").is_file():
            return option_summary(key, option, folder)
    settings = {f"{group}.{name}".lstrip("."): setting for group, name, setting in all_settings()}
    return settings[key].meaning if key in settings and not value else ""


def _split(line: str) -> list[str]:
    """Split a line into words, the last of them up to the cursor; an open quotation mark ends with the line."""
    for closing in ("", "'", '"'):
        try:
            words = shlex.split(line + closing)
        except ValueError:
            continue
        return [*words, ""] if not closing and line[-1:].isspace() else words or [""]
    return ["", ""]


def _starting(prefix: str, candidates: Iterable[str]) -> list[str]:
    return sorted({candidate for candidate in candidates if candidate.startswith(prefix)})


def _flags(verb: Verb, arguments: Iterable[Argument], first: bool) -> list[str]:
    flags = [flag for argument in arguments for flag in argument.flags]
    hydra = [flag for spellings in HYDRA_FLAGS for flag in spellings] if verb.composes else []
    return [*flags, *hydra, "-h", "--help", *(["--version"] if first else [])]


def _option_folders(words: list[str]) -> list[Path]:
    """Return the folders of options: the built-in one, and those of ``--config-dir`` on the line."""
    named = [word.partition("=")[2] for word in words if re.match("(--config-dir|-cd)=", word)]
    named += [value for flag, value in itertools.pairwise(words) if flag in ("--config-dir", "-cd")]
    return [conf_dir(), *(Path(folder).expanduser() for folder in named)]


def _settings(current: str, folders: list[Path]) -> list[str]:
    """Return keys as far as they are typed: ``camera=``, ``camera.``, and the keys of ``camera.`` once it is typed."""
    added = {path.name for folder in folders for path in folder.glob("*/")}
    keys = [f"{name}=" for name in settings_of(Config)]
    for group, kind in GROUPS.items():
        keys.append(f"{group}.")
        if len(group_options(group, *folders)) > 1:
            keys.append(f"{group}=")
        if current.startswith(f"{group}."):
            keys += [f"{group}.{name}=" for name in settings_of(kind)]
    typed = current.endswith(".") or "." in current
    plus = sorted(added - set(GROUPS))
    return [key for key in keys if not (typed and key.endswith("."))] + [f"+{group}=" for group in plus]


def _values(key: str, current: str, folders: list[Path]) -> tuple[str, list[str]]:
    """Return the values of a key: options of a group, strings, booleans, folders; and of the last item of a list."""
    if key == "out":
        return FOLDERS, []
    if key == "source.root":
        return FILES, []
    group, _, name = key.lstrip("+").partition(".")
    values: Iterable[str] = () if name else group_options(group, *folders)
    limit = next((setting.limit for *path, setting in all_settings() if ".".join(filter(None, path)) == key), None)
    if isinstance(limit, Boolean):
        values = ("true", "false")
    elif isinstance(limit, Choice):
        values = limit.words
    before, comma, _ = current.rpartition(",")  # of a sweep: camera=sony_a7r,nex
    listed = before.partition("=")[2].split(",")
    start = f"{before}," if comma else f"{key}="
    return WORDS, _starting(current, (f"{start}{value}" for value in values if value not in listed))
