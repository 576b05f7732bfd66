#!/usr/bin/env bash
# pip with its output in short: what is downloaded or installed, and the time that has passed. A
# line for every large download, and one at least every ten seconds. Called by make.
#
#     install.sh PIP ARGUMENT ...
set -uo pipefail

say() { printf '  %d:%02d  %s\n' $((SECONDS / 60)) $((SECONDS % 60)) "$1"; }

now='looking for the packages' begun=
PYTHONUNBUFFERED=1 "$1" install --disable-pip-version-check --no-color --progress-bar off "${@:2}" |
    while true; do
        if IFS= read -r -t "${INSTALL_INTERVAL:-10}" line; then
            line=$begun$line begun=
            case $line in
                *Downloading\ *.whl*|*'Using cached '*.whl*|*Processing\ *.whl*)
                    file=${line#*Downloading }
                    file=${file#*Using cached }
                    file=${file##*/} # without an address or a folder
                    file=${file/\%2B/+}
                    size=$(grep -oE '\([0-9.]+ [kMG]?B\)' <<<"$file")
                    IFS=- read -r name version _ <<<"$file"
                    now="$name $version $size"
                    # the large ones
                    if [[ $size =~ [0-9]{2}\.?[0-9]*\ MB|GB ]]; then say "$now"; fi ;;
                'Installing build dependencies'*|'Preparing'*|'Building wheel'*)
                    now=${line%%:*} ;;
                'Installing collected packages'*)
                    packages=${line#*: }
                    commas=${packages//[^,]/}
                    now="installing $((${#commas} + 1)) packages"
                    say "$now" ;;
                'Successfully installed'*)
                    say 'installed' ;;
            esac
        elif (($? > 128)); then # no whole line came for ten seconds
            begun+=$line
            say "$now"
        else
            break
        fi
    done
