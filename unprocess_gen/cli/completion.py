"""Complete command lines in bash and zsh: verbs, flags, settings and options.

``gen-dataset completion bash`` prints a script. Its function calls ``gen-dataset completion query LINE`` with the line
up to the cursor. The query prints the kind of completion (``words``, ``folders``, ``files``) and the candidates.

Design: ``docs/design/command_line.md``.
"""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Iterable
from pathlib import Path

from unprocess_gen.cli.arguments import ANY_VALUE, HYDRA_FLAGS, STANDARD, Call
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.config.limits import Boolean, Choice
from unprocess_gen.config.option_files import conf_dir, group_options
from unprocess_gen.config.schema import GROUPS, Config, all_settings
from unprocess_gen.config.settings import settings_of
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.suggestions import did_you_mean

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
    local word
    local -a lines closed open
    lines=("${(@f)$("${words[1]}" completion query "${(j: :)words[1,CURRENT-1]} $PREFIX" 2>/dev/null)}")
    case ${lines[1]} in
        folders) compset -P '*='; _files -/ ;;
        files) compset -P '*='; _files ;;
        words)
            for word in "${(@)lines[2,-1]}"; do
                if [[ $word == *[.=] ]]; then open+=("$word"); else closed+=("$word"); fi
            done
            (( $#closed )) && compadd -- "${(@)closed}"
            (( $#open )) && compadd -S '' -- "${(@)open}" ;;
    esac
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }
compdef _gen_dataset gen-dataset
"""

SCRIPTS = {"bash": BASH, "zsh": ZSH}


def completion(call: Call) -> int:
    """Print the script of a shell, or the candidates for its query."""
    match call.words:
        case ["query", line]:
            kind, candidates = complete(line)
            print("\n".join([kind, *candidates]))
        case [shell] if shell in SCRIPTS:
            print(SCRIPTS[shell].lstrip("\n"), end="")
        case words:
            word = " ".join(words)
            raise ConfigError(f"completion: {word or 'no shell'}: expected bash or zsh{did_you_mean(word, SCRIPTS)}")
    return 0


def complete(line: str) -> tuple[str, list[str]]:
    """Return how the last word of a line can be completed: the kind, and for ``words`` the complete candidates.

    The shell completes names of ``folders`` and ``files`` by itself.
    """
    *before, current = _split(line)
    name = next(iter(before[1:2]), "")
    verb = VERBS.get(name, VERBS["generate"])
    arguments = (*verb.arguments, *STANDARD)
    hydra = HYDRA_FLAGS if verb.composes else {}
    last = before[-1] if len(before) > 1 else ""
    for argument in arguments:
        if argument.metavar and last in argument.flags:
            return argument.completes or WORDS, []
    for spellings, (values, _) in hydra.items():
        if values and last in spellings:
            return (FILES, []) if values == ANY_VALUE else (WORDS, _starting(current, values))
    if current.startswith("-"):
        flags = [flag for argument in arguments for flag in argument.flags]
        flags += ["-h", "--help", *(["--version"] if len(before) == 1 else [])]
        return WORDS, _starting(current, [*flags, *itertools.chain(*hydra)])
    key, equals, _ = current.partition("=")
    if equals:
        for argument in arguments:
            if key in argument.settings:
                return argument.completes or WORDS, []
        return _values(key, current, _option_folders(before)) if verb.composes else (WORDS, [])
    candidates = [f"{key}=" for argument in arguments for key in argument.settings]
    candidates += VERBS if len(before) == 1 and re.fullmatch("[a-z]*", current) else ()
    candidates += _settings(current, _option_folders(before)) if verb.composes else ()
    words = _starting(current, [*candidates, *verb.words])
    return (verb.place.completes, []) if verb.place and not (words and current) else (WORDS, words)


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


def _option_folders(words: list[str]) -> list[Path]:
    """Return the folders of options: the built-in one, and those of ``--config-dir`` on the line."""
    named = [word.partition("=")[2] for word in words if re.match("(--config-dir|-cd)=", word)]
    named += [value for flag, value in itertools.pairwise(words) if flag in ("--config-dir", "-cd")]
    return [conf_dir(), *(Path(folder).expanduser() for folder in named)]


def _settings(current: str, folders: list[Path]) -> list[str]:
    """Return keys as far as they are typed: ``camera=``, ``camera.``, and the keys of ``camera.`` once it is typed."""
    group = current.partition(".")[0]
    if "." in current:
        return [f"{group}.{name}=" for name in settings_of(GROUPS[group])] if group in GROUPS else []
    added = {path.name for folder in folders for path in folder.glob("*/")} - set(GROUPS)
    chosen = [name for name in GROUPS if len(group_options(name, *folders)) > 1]
    keys = [f"{name}=" for name in (*settings_of(Config), *chosen)]
    return [*keys, *(f"{name}." for name in GROUPS), *(f"+{name}=" for name in added)]


def _values(key: str, current: str, folders: list[Path]) -> tuple[str, list[str]]:
    """Return the values of a key: options of a group, words, folders; also of the last item of a sweep's list."""
    if key in ("out", "source.root"):
        return (FOLDERS if key == "out" else FILES), []
    limit = next((setting.limit for *path, setting in all_settings() if ".".join(filter(None, path)) == key), None)
    values: Iterable[str] = () if "." in key else group_options(key.lstrip("+"), *folders)
    if isinstance(limit, Boolean):
        values = ("true", "false")
    elif isinstance(limit, Choice):
        values = limit.words
    before, comma, _ = current.rpartition(",")  # of a sweep: camera=sony_a7r,nex
    listed = before.partition("=")[2].split(",")
    start = f"{before}," if comma else f"{key}="
    return WORDS, _starting(current, (f"{start}{value}" for value in values if value not in listed))
