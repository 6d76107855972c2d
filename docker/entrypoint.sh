#!/bin/sh
# Reads secrets from files, then runs the command: NAME_FILE=/run/secrets/name becomes NAME, in this process alone.
# So no secret stands in a compose file, in a manifest or in what `docker inspect` shows.
set -eu
for name in SPICD_REDIS_URL SPICD_DATABASE_URL PGPASSWORD AWS_ACCESS_KEY_ID AWS_SECRET_ACCESS_KEY \
    AWS_SESSION_TOKEN OTEL_EXPORTER_OTLP_HEADERS; do
    eval "file=\${${name}_FILE:-}"
    [ -n "$file" ] || continue
    [ -r "$file" ] || { echo "${name}_FILE: $file cannot be read by user $(id -u)" >&2; exit 78; }
    value=$(cat "$file")
    export "$name=$value"
    unset "${name}_FILE"
done
exec "$@"
