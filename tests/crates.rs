//! The cores only compute: no core depends on a crate that waits, sends or opens files, and none reads a
//! clock.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail the test")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use test_support::limited::Limited;

/// Each core and its folder.
const CORES: [(&str, &str); 19] = [
    ("foreign_text", "crates/foreign_text"),
    ("openigtlink", "crates/openigtlink"),
    ("markups", "crates/markups"),
    ("ros_interface", "crates/ros_interface"),
    ("messages", "crates/messages"),
    ("voxel_grid", "crates/voxel_grid"),
    ("counter_random", "crates/counter_random"),
    ("sensors", "crates/sensors"),
    ("scene", "crates/scene"),
    ("structures", "crates/structures"),
    ("simulation", "crates/simulation"),
    ("controllers", "crates/controllers"),
    ("run_log", "crates/run_log"),
    ("xray", "crates/xray"),
    ("sweep", "crates/sweep"),
    ("identify", "crates/identify"),
    ("hub", "crates/hub"),
    ("delivery", "crates/delivery"),
    ("hub_schedules", "crates/hub/schedules"),
];

/// Crates that no core may reach, and why. Only normal dependencies count: tests and build scripts may use
/// them.
const KEPT_OUT: [(&str, &str); 17] = [
    ("iceoryx2", "shared memory: a core that sends can be driven by nothing but the real transport"),
    ("ipc_types", "sessions, ports and the monotonic clock: the transport itself"),
    ("memmap2", "maps files and shared memory"),
    ("rustix", "system calls: files, processes, clocks, priorities"),
    ("nix", "system calls: limits and priorities of processes"),
    ("signal-hook", "who handles signals owns the process"),
    ("tokio", "an async runtime: sockets, timers, threads of its own"),
    ("mio", "sockets and readiness: what async runtimes stand on"),
    ("tempfile", "files"),
    ("output_file", "files that commands leave behind"),
    ("getrandom", "randomness that no seed repeats"),
    ("rayon", "threads: an order of sums that the scheduler chooses"),
    ("jiff", "dates and the wall clock"),
    ("chrono", "dates and the wall clock"),
    ("instant", "a clock under another name"),
    ("web-time", "a clock under another name; Rapier's profiler would bring it in"),
    ("quanta", "a clock under another name"),
];

/// Exceptions that a core reaches, and why. A line that is no longer needed fails the test.
const REACHED_ALL_THE_SAME: [(&str, &str, &str); 1] = [(
    "xray",
    "rayon",
    "each row of an image and each slab of a volume is computed whole by one thread, and what is added up are integers, so no schedule \
     shows in a frame (tests in crates/xray/tests/drr compare numbers of threads); the threads are those of a pool that the caller hands in",
)];

/// Names that no core's source may contain, and why.
const UNSAID: [(&str, &str); 21] = [
    ("Instant", "the monotonic clock"),
    ("SystemTime", "the wall clock"),
    ("UNIX_EPOCH", "the wall clock"),
    ("std::time", "clocks; time comes in as a number"),
    ("std::fs", "files"),
    ("File", "files"),
    ("std::net", "sockets"),
    ("std::os", "what only one operating system has"),
    ("std::process", "processes; only programs end"),
    ("std::env", "the environment: the same input gives the same result"),
    ("std::path::absolute", "reads the current folder"),
    ("thread::sleep", "waits; a core returns what is to be waited for"),
    ("thread::spawn", "a thread that outlives the call"),
    ("ThreadPoolBuilder", "threads that outlive the call"),
    ("stdin", "the terminal"),
    ("stdout", "the terminal"),
    ("stderr", "the terminal"),
    ("println!", "the terminal"),
    ("print!", "the terminal"),
    ("eprintln!", "the terminal"),
    ("std::{", "an import that this test does not look into: write one line for each"),
];

/// Exceptions: file, name, and why. A line that is no longer needed fails the test.
const SAID_ALL_THE_SAME: [(&str, &str, &str); 1] = [(
    "crates/scene/src/lib.rs",
    "std::path::absolute",
    "a scene's text is copied to other folders, so its relative paths are made absolute when it is read",
)];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns the platform for which cargo builds here, as named by rustc.
fn host() -> String {
    let rustc = std::env::var("RUSTC").unwrap_or_else(|_| "rustc".to_owned());
    let output = Command::new(rustc).arg("-vV").current_dir(root()).limited_output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    let host = text.lines().find_map(|line| line.strip_prefix("host: "));
    host.unwrap_or_else(|| panic!("rustc -vV: {text}")).to_owned()
}

/// The normal dependencies of every package of the lock file, by id, and the packages' names.
struct Graph {
    names: BTreeMap<String, String>,
    normal: BTreeMap<String, Vec<String>>,
}

impl Graph {
    fn read() -> Graph {
        // Only the dependencies of this machine's build: cargo has not fetched the crates of other platforms.
        let of_host = ["--format-version", "1", "--filter-platform", &host()];
        let metadata = cargo(&[&["metadata", "--offline", "--locked"], &of_host[..]].concat());
        Graph::of(&serde_json::from_str(&metadata).unwrap())
    }

    fn of(metadata: &Value) -> Graph {
        let text = |value: &Value| value.as_str().unwrap().to_owned();
        let list = |value: &Value| value.as_array().unwrap().clone();
        let names = list(&metadata["packages"]).iter().map(|p| (text(&p["id"]), text(&p["name"]))).collect();
        // `workspace_hack` has no code and names crates for their features only.
        let is_normal = |dep: &Value| {
            let is_hack = text(&dep["pkg"]).contains("/workspace_hack#");
            !is_hack && list(&dep["dep_kinds"]).iter().any(|kind| kind["kind"].is_null())
        };
        let normal_of = |node: &Value| {
            list(&node["deps"]).iter().filter(|dep| is_normal(dep)).map(|dep| text(&dep["pkg"])).collect()
        };
        let nodes = list(&metadata["resolve"]["nodes"]);
        Graph { names, normal: nodes.iter().map(|node| (text(&node["id"]), normal_of(node))).collect() }
    }

    /// Returns the shortest path from one crate to another, by names.
    fn way(&self, from: &str, to: &str) -> Option<Vec<String>> {
        let (start, _) = self.names.iter().find(|(_, name)| *name == from)?;
        let mut seen = BTreeSet::from([start.clone()]);
        let mut ways = vec![vec![start.clone()]];
        while !ways.is_empty() {
            let mut longer = Vec::new();
            for way in ways {
                let last = way.last()?;
                if self.names[last] == to {
                    return Some(way.iter().map(|id| self.names[id].clone()).collect());
                }
                for next in self.normal[last].iter().filter(|next| seen.insert((*next).clone())) {
                    longer.push(way.iter().chain([next]).cloned().collect());
                }
            }
            ways = longer;
        }
        None
    }
}

#[test]
fn no_core_depends_on_iceoryx2_or_on_another_crate_that_does_more_than_compute() {
    let graph = Graph::read();
    // An existing path is found.
    assert!(
        graph.way("physics_proc", "iceoryx2").is_some_and(|way| way.len() == 3),
        "physics, transport, iceoryx2"
    );
    let (mut found, mut needed) = (Vec::new(), BTreeSet::new());
    for (core, _) in CORES {
        assert!(graph.names.values().any(|name| name == core), "no crate {core}");
        for (crate_, reason) in KEPT_OUT {
            let Some(way) = graph.way(core, crate_) else { continue };
            match REACHED_ALL_THE_SAME.iter().position(|(from, to, _)| (*from, *to) == (core, crate_)) {
                Some(index) => _ = needed.insert(index),
                None => found.push(format!("{} ({reason})", way.join(" -> "))),
            }
        }
    }
    assert!(found.is_empty(), "a core reaches what it must not:\n{}", found.join("\n"));
    assert_eq!(needed.len(), REACHED_ALL_THE_SAME.len(), "an exception that nothing needs any more");
}

/// Runs cargo in the workspace and returns its output.
fn cargo(words: &[&str]) -> String {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".to_owned());
    let output = Command::new(cargo).args(words).current_dir(root()).limited_output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "cargo {}: {error}", words.join(" "));
    String::from_utf8(output.stdout).unwrap()
}

/// Returns every crate of a build with its features there, as printed by `cargo tree`.
fn crates_with_features(selection: &[&str]) -> BTreeSet<String> {
    let tree = ["tree", "--offline", "--locked", "--format", "{p} {f}", "--prefix", "none"];
    let lines = cargo(&[&tree[..], selection].concat());
    // `(*)` marks a crate whose dependencies are listed already.
    lines.lines().map(|line| line.trim_end_matches(" (*)").to_owned()).collect()
}

/// Returns the names of the workspace's packages.
fn members() -> Vec<String> {
    let metadata = cargo(&["metadata", "--offline", "--locked", "--no-deps", "--format-version", "1"]);
    let metadata: Value = serde_json::from_str(&metadata).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    packages.iter().map(|package| package["name"].as_str().unwrap().to_owned()).collect()
}

/// Asserts that each selection gives every crate the same features as in a build of the whole workspace with
/// its tests.
fn assert_one_build_of_each_crate<'a>(selections: impl IntoIterator<Item = Vec<&'a str>>, edges: &str) {
    let whole = crates_with_features(&["--workspace", "--edges", "normal,build,dev"]);
    let mut apart = BTreeMap::<String, String>::new();
    for selection in selections {
        let crates = crates_with_features(&[&selection[..], &["--edges", edges]].concat());
        assert!(!crates.is_empty(), "{selection:?}");
        for crate_ in crates.difference(&whole) {
            apart.entry(crate_.clone()).or_insert_with(|| selection.join(" "));
        }
    }
    let named = |crate_: &str| crate_.split(' ').take(2).collect::<Vec<_>>().join(" ") + " ";
    let lines = apart.iter().map(|(crate_, selection)| {
        let wanted = whole.iter().filter(|line| line.starts_with(&named(crate_))).cloned();
        format!("`{selection}`: {crate_}; the workspace: {}", wanted.collect::<Vec<_>>().join(" or "))
    });
    let lines: Vec<_> = lines.collect();
    let hint = "add the workspace's features to crates/workspace_hack/Cargo.toml";
    assert!(lines.is_empty(), "built twice, with other features ({hint}):\n{}", lines.join("\n"));
}

/// Regression: `pip install .` after `cargo run`, and `cargo build` after it, rebuilt most crates.
#[test]
fn every_build_shares_all_of_its_crates_with_the_build_of_the_workspace() {
    let members = members();
    let of_each = members.iter().map(|member| vec!["-p", member]);
    // The builds of `cargo run` and of clients/python/build_backend.py.
    let run_and_pip = [
        vec![],
        vec!["-p", "trabecula", "-p", "trabecula_client", "-p", "trabecula_sim", "-p", "trabecula_fmu"],
    ];
    assert_one_build_of_each_crate(run_and_pip.into_iter().chain(of_each), "normal,build");
}

/// Regression: the same with `cargo test -p hub` after `cargo run`.
#[test]
fn the_tests_of_every_package_share_all_of_their_crates_with_the_build_of_the_workspace() {
    let members = members();
    let of_each = members.iter().map(|member| vec!["-p", member]);
    assert_one_build_of_each_crate(of_each, "normal,build,dev");
}

#[test]
fn dependencies_of_tests_and_build_scripts_do_not_count() {
    let kinds = |kind: &str| format!(r#"{{"pkg": "b", "dep_kinds": [{{"kind": {kind}}}]}}"#);
    let graph = |kind: &str| {
        let nodes = format!(r#"[{{"id": "a", "deps": [{}]}}, {{"id": "b", "deps": []}}]"#, kinds(kind));
        let packages = r#"[{"id": "a", "name": "hub"}, {"id": "b", "name": "tokio"}]"#;
        let text = format!(r#"{{"packages": {packages}, "resolve": {{"nodes": {nodes}}}}}"#);
        Graph::of(&serde_json::from_str(&text).unwrap())
    };
    assert_eq!(graph("null").way("hub", "tokio"), Some(vec!["hub".to_owned(), "tokio".to_owned()]));
    assert_eq!(graph(r#""dev""#).way("hub", "tokio"), None);
    assert_eq!(graph(r#""build""#).way("hub", "tokio"), None);
}

/// Returns the lines of a source that are compiled into the crate, with their numbers: no comments, and
/// nothing after `#[cfg(test)]`.
fn code_of(source: &str) -> Vec<(usize, &str)> {
    let mut in_tests = false;
    let mut code = Vec::new();
    for (index, line) in source.lines().enumerate() {
        in_tests |= line == "#[cfg(test)]";
        if !in_tests {
            let end = line.find("//").unwrap_or(line.len());
            code.push((index + 1, &line[..end]));
        }
        // In rustfmt's layout, an item ends with a brace or a semicolon in a line that is not indented.
        in_tests &= !(line == "}" || (!line.starts_with([' ', '#']) && line.ends_with(';')));
    }
    code
}

/// Returns whether a line contains this text as whole words, in any context.
fn says(line: &str, what: &str) -> bool {
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    line.match_indices(what).any(|(at, _)| {
        let before = line[..at].chars().next_back().is_some_and(is_word);
        let after = what.ends_with(is_word) && line[at + what.len()..].chars().next().is_some_and(is_word);
        !before && !after
    })
}

/// Returns the Rust files below a folder that belong to a library; programs (`main.rs`, `bin/`) are shells.
fn library_sources(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap_or_default();
        if path.is_dir() && name != "bin" {
            found.extend(library_sources(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") && name != "main.rs" {
            found.push(path);
        }
    }
    found
}

#[test]
fn no_core_reads_a_clock_a_file_a_socket_or_the_environment() {
    let mut needed = BTreeSet::new();
    let mut found = Vec::new();
    for (_, folder) in CORES {
        let sources = library_sources(&root().join(folder).join("src"));
        assert!(!sources.is_empty(), "{folder} has no source");
        for path in sources {
            let file = path.strip_prefix(root()).unwrap().to_str().unwrap().to_owned();
            let source = std::fs::read_to_string(&path).unwrap();
            for (number, line) in code_of(&source) {
                for (what, reason) in UNSAID.iter().filter(|(what, _)| says(line, what)) {
                    let all_the_same =
                        SAID_ALL_THE_SAME.iter().position(|(at, said, _)| (*at, said) == (&*file, what));
                    match all_the_same {
                        Some(index) => _ = needed.insert(index),
                        None => found.push(format!("{file}:{number}: {what} ({reason}): {}", line.trim())),
                    }
                }
            }
        }
    }
    assert!(found.is_empty(), "a core does more than compute:\n{}", found.join("\n"));
    assert_eq!(needed.len(), SAID_ALL_THE_SAME.len(), "an exception that nothing needs any more");
}

#[test]
fn tests_and_comments_of_a_core_may_name_a_clock_and_its_code_may_not() {
    let source = "\
use std::time::Instant;
/// No Instant is read.
fn f() {} // nor std::fs
#[cfg(test)]
use std::fs;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    fn now() -> Instant {
        Instant::now();
    }
}
fn g() { thread::sleep(x) }
";
    let said: Vec<(usize, &str)> = code_of(source)
        .into_iter()
        .flat_map(|(number, line)| {
            UNSAID.iter().filter(move |(what, _)| says(line, what)).map(move |(what, _)| (number, *what))
        })
        .collect();
    assert_eq!(said, [(1, "Instant"), (1, "std::time"), (13, "thread::sleep")]);
    assert!(!says("Instantaneous", "Instant") && !says("my_File", "File") && !says("eprintln!(", "println!"));
}
