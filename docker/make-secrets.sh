#!/bin/sh
# Makes the secrets that docker/compose.yaml needs, where they are missing. From the project's root:
#   sh docker/make-secrets.sh [FOLDER]
# Compose hands files to containers with the rights that they have here. The containers' users differ, so the files can
# be read by all, and the folder by nobody but you.
set -eu
folder=${1:-"$(dirname "$0")/secrets"}
umask 077
mkdir -p "$folder"
chmod 0700 "$folder"

random() { # BYTES; hexadecimal, so that it fits into any file
    od -An -N"$1" -tx1 /dev/urandom | tr -d ' \n'
}

keep() { # NAME, content on stdin; what is there stays
    if [ -s "$folder/$1" ]; then
        cat >/dev/null
        return
    fi
    cat >"$folder/$1.part"
    chmod 0444 "$folder/$1.part"
    mv "$folder/$1.part" "$folder/$1"
    echo "made $folder/$1"
}

random 24 | keep postgres_password
printf 'spicd_%s' "$(random 32)" | keep first_key
random 10 | keep s3_access_key
random 24 | keep s3_secret_key
keep s3.json <<JSON
{"identities": [{"name": "spicd", "actions": ["Admin", "Read", "Write", "List", "Tagging"],
  "credentials": [{"accessKey": "$(cat "$folder/s3_access_key")", "secretKey": "$(cat "$folder/s3_secret_key")"}]}]}
JSON
