#!/bin/sh
# A front server in a container: this machine joins the Ray cluster at RAY_HEAD (host:port) without CPUs, and serves.
set -eu
ray start --address "${RAY_HEAD:?expected host:port of the Ray head}" --num-cpus 0 --object-store-memory 100000000 \
    --disable-usage-stats
exec surrogym serve --engine ray --ray-address auto "$@"
