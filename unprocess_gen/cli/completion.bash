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
