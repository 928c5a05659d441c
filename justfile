# Shortcuts for daily work; `just` lists them (https://just.systems).

_list:
    @just --list

# the fast tests: no processes, downloads or browsers
test *arguments:
    cargo nextest run --cargo-profile quick --workspace --profile fast {{arguments}}

# every test, including those in documentation, as run by README.md and .ci/run
test-all:
    cargo test --workspace --release

# the steps of .ci/run without the tests: format, lints, licences, documents, types (or: just check clippy docs)
check *steps="format clippy minimum deny docs page python scenes site fuzz readme":
    .ci/run {{steps}}

# the documentation of every crate, in target/doc
docs:
    RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps --release

# generate the references, the C header and the Python module from their sources
generate:
    cargo run --release -- docs scene > target/scene.md && mv target/scene.md docs/scene.md
    cargo run --release -- docs messages > target/messages.md && mv target/messages.md docs/messages.md
    cargo run --release -p trabecula_client --bin trabecula_client_bindings -- c > target/trabecula.h && mv target/trabecula.h clients/c/include/trabecula.h
    cargo run --release -p trabecula_client --bin trabecula_client_bindings -- python > target/_generated.py && mv target/_generated.py clients/python/trabecula/_generated.py

# run every fuzz target for some seconds, or only the given ones: just fuzz 60 nifti dicom
fuzz seconds="600" *targets:
    fuzz/run -s {{seconds}} {{targets}}

# run the hub under seeded schedules: just schedules 10000000
schedules count="1000000":
    cargo run --release -p hub_schedules --bin hub_schedules -- --count {{count}}

# check that the schedules detect each broken version of the hub
mutants *name:
    cargo run --release -p hub_schedules --example hub_mutants -- {{name}}
