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
