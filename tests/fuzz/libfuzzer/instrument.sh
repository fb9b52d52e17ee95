#!/bin/sh
# A wrapper of rustc: counts what is executed of the project's crates. Counted ciphers take several times as long, and show nothing.
case " $* " in
# The compiler loads it, and has no counters.
*" --crate-name cara_derive "*) exec "$@" ;;
*" --crate-name cara_"*)
    exec "$@" -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
        -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table
    ;;
*) exec "$@" ;;
esac
