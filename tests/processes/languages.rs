//! The clients of every language: the numbered examples, run as their README says, each with its own run.
//!
//! `02_follow_curve` does the same arithmetic in the same order in every language, so a lockstep run ends
//! with the same hash in each; all examples print the same lines.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use ipc_types::session::SESSION_VARIABLE;

use crate::common::logs::read;
use crate::common::program::{LIMIT, Place, Run, assert_nothing_left};
use crate::python::python;
use test_support::limited::Limited;
use test_support::python::{downloads, or_skip};

const EXAMPLES: [(&str, &str); 3] = [
    ("01_hold_tension", "free_space.toml"),
    ("02_follow_curve", "free_space.toml"),
    ("03_image_guided", "image_guided.toml"),
];
/// A complete compiler as a Python package.
const ZIG: &str = "ziglang==0.14.1";

pub fn clients() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("clients")
}

/// Returns the folder of cargo's build output.
pub fn built() -> PathBuf {
    Path::new(env!("CARGO_BIN_EXE_trabecula")).parent().unwrap().to_owned()
}

/// Returns the library, which cargo builds as a dependency of this package's tests.
pub fn library() -> PathBuf {
    let path = built().join("deps/libtrabecula_client.so");
    assert!(path.exists(), "{}: not built", path.display());
    path
}

/// Runs a program to its end and returns what it printed; anything on standard error or another exit code
/// fails.
pub fn output_of(command: &mut Command) -> String {
    let output = command.limited_output().unwrap_or_else(|cause| panic!("{command:?}: {cause}"));
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {}\n{error}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

/// Returns the line of a README that begins with these words, split into words.
fn line_of(readme: &str, begin: &str) -> Vec<String> {
    let text = fs::read_to_string(clients().join(readme)).unwrap();
    let line = text.lines().find(|line| line.starts_with(begin));
    let line = line.unwrap_or_else(|| panic!("{readme} has no line that begins with `{begin}`"));
    line.split_whitespace().map(str::to_owned).collect()
}

/// The same for a program that a defect may hang: it is killed at [`LIMIT`].
pub fn output_within_limit(command: &mut Command) -> String {
    let output = command.output_within(LIMIT).unwrap_or_else(|cause| panic!("{command:?}: {cause}"));
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (said, error) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{command:?}: {}\n{said}{error}", output.status);
    said
}

/// Compiles an example with the compiler line of the README, in which only folders and output are replaced.
fn compiled(language: &str, compiler: &str, name: &str, place: &Place) -> PathBuf {
    compiled_source(language, compiler, &format!("examples/{name}"), place)
}

/// A program of `clients/c/tests`, compiled in the same way.
pub fn compiled_test(name: &str, place: &Place) -> PathBuf {
    compiled_source("c", "cc ", &format!("tests/{name}"), place)
}

fn compiled_source(language: &str, compiler: &str, source: &str, place: &Place) -> PathBuf {
    let program = place.path(&format!("{language}_{}", source.replace('/', "_")));
    let folder = library().parent().unwrap().to_str().unwrap().to_owned();
    let words = line_of(&format!("{language}/README.md"), compiler);
    let words: Vec<String> = words
        .iter()
        .map(|word| word.replace("$PWD/", "").replace("target/release", &folder))
        .map(|word| word.replace("examples/02_follow_curve", source))
        .map(|word| if word == "follow_curve" { program.to_str().unwrap().to_owned() } else { word })
        .collect();
    let mut command = Command::new(&words[0]);
    command.current_dir(env!("CARGO_MANIFEST_DIR")).args(&words[1..]);
    command.args(["-Wall", "-Wextra", "-Wpedantic", "-Werror"]);
    output_of(&mut command);
    program
}

/// Returns a Python that has the Zig compiler.
pub fn zig() -> Option<PathBuf> {
    or_skip(&ZIG.replace("==", "-"), &[ZIG], "ziglang")
}

/// Returns the program of an example in a language, if the language is available.
fn program_of(language: &str, name: &str, place: &Place) -> Option<Command> {
    match language {
        "rust" => {
            let program = built().join("examples").join(name);
            let hint = "`cargo build --release --workspace --examples` builds it";
            assert!(program.exists(), "{}: not built; {hint}", program.display());
            Some(Command::new(program))
        }
        "c" => Some(Command::new(compiled("c", "cc ", name, place))),
        "cpp" => Some(Command::new(compiled("cpp", "c++ ", name, place))),
        "python" => {
            let mut command = Command::new(python()?);
            command.arg(clients().join(format!("python/examples/{name}.py")));
            Some(command)
        }
        "zig" => Some(Command::new(compiled_by_zig(&zig()?, name, place))),
        other => panic!("no language {other}"),
    }
}

/// Compiles an example with the compiler line of the README; the compiler caches its output.
fn compiled_by_zig(python: &Path, name: &str, place: &Place) -> PathBuf {
    let program = place.path(&format!("zig_{name}"));
    let folder = library().parent().unwrap().to_str().unwrap().to_owned();
    let cache = downloads().join("zig-cache");
    let words = line_of("zig/README.md", "python3 -m ziglang build-exe");
    let words = words.iter().skip(1).map(|word| {
        let word =
            word.replace("$PWD/", "").replace("target/release", &folder).replace("02_follow_curve", name);
        if word.starts_with("-femit-bin=") { format!("-femit-bin={}", program.display()) } else { word }
    });
    let mut command = Command::new(python);
    command.current_dir(env!("CARGO_MANIFEST_DIR")).args(words);
    command.env("ZIG_GLOBAL_CACHE_DIR", &cache).env("ZIG_LOCAL_CACHE_DIR", &cache);
    output_of(&mut command);
    program
}

/// Runs an example; returns its output and the hash of the run's last tick.
fn run_example(command: &mut Command, scene: &str, place: &Place) -> (String, [u64; 2]) {
    let output = place.path(&format!("out_{}", fs::read_dir(place.path("")).unwrap().count()));
    let run = Run::start(&clients().join("scenes").join(scene), output, &[]);
    let printed = output_of(command.env(SESSION_VARIABLE, run.session()));
    let ended = run.end_well();
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    let last = log.ticks.last().unwrap().state;
    assert_eq!(last.tick, 1000);
    (printed, last.hash)
}

const LANGUAGES: [&str; 5] = ["rust", "c", "cpp", "python", "zig"];

#[test]
fn every_example_prints_the_same_and_ends_with_the_same_hash_in_every_language() {
    let place = Place::new();
    for (name, scene) in EXAMPLES {
        let mut results = Vec::new();
        for language in LANGUAGES {
            if let Some(mut command) = program_of(language, name, &place) {
                let (printed, hash) = run_example(&mut command, scene, &place);
                println!("{name} {language:6} {:016x}{:016x}", hash[1], hash[0]);
                results.push((language, printed, hash));
            }
        }
        let (_, printed, hash) = &results[0];
        assert!(printed.lines().count() >= 5, "{printed}");
        for (language, other_printed, other_hash) in &results {
            assert_eq!(other_printed, printed, "{name} in {language} prints something else");
            assert_eq!(other_hash, hash, "{name} in {language} ends with another hash");
        }
        println!("{printed}");
    }
}

/// The C README's other way to link.
#[test]
fn a_program_may_link_the_static_library() {
    let place = Place::new();
    let archive = library().with_extension("a");
    assert!(archive.exists(), "{}: not built", archive.display());
    let program = place.path("hold_tension");
    let mut compiler = Command::new("cc");
    compiler.current_dir(clients()).args(["-O2", "-I", "c/include", "c/examples/01_hold_tension.c", "-o"]);
    output_of(compiler.arg(&program).arg(&archive).args(["-lpthread", "-ldl", "-lm"]));
    let (printed, _) = run_example(&mut Command::new(program), "free_space.toml", &place);
    assert!(printed.lines().count() >= 5, "{printed}");
}
