//! The display of a running run: a table that is updated in place on a terminal, lines elsewhere, JSON for
//! scripts.

use std::path::Path;
use std::process::{Command, Stdio};
use test_support::limited::limited_output_of;

use crate::common::program::{LIMIT, Place};
use crate::common::scenes;

/// Runs the command in its own terminal (with Python's standard library), and prints the output.
const IN_TERMINAL: &str = "import pty, sys; sys.exit(pty.spawn(sys.argv[1:]) >> 8)";

#[test]
fn a_terminal_shows_a_table_with_sparklines_a_pipe_lines_and_json_stands_alone() {
    let place = Place::new();
    // Longer than the two seconds between two lines.
    let scene = place.scene(&scenes::hold("realtime", 2.4));
    let run = |name: &str, more: &[&str]| {
        let output = place.path(name);
        let program = Path::new(env!("CARGO_BIN_EXE_trabecula"));
        let (mut command, before) = match name {
            "terminal" => (Command::new("python3"), vec!["-c".into(), IN_TERMINAL.into(), program.into()]),
            _ => (Command::new(program), Vec::<std::ffi::OsString>::new()),
        };
        command.args(before).arg("run").arg(&scene).arg("--output").arg(output).args(more);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    };
    let [terminal, pipe, json] =
        [run("terminal", &[]), run("pipe", &[]), run("json", &["--json"])].map(|child| {
            let output = limited_output_of(child, LIMIT, "a run");
            let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
            assert!(output.status.success(), "{}{}", text(&output.stdout), text(&output.stderr));
            (text(&output.stdout), text(&output.stderr))
        });

    // Both streams of the run go to the terminal.
    let (shown, _) = terminal;
    for words in ["\x1b[A", "\x1b[K", "step    p99", "latency p99", "▁"] {
        assert!(shown.contains(words), "{words:?} is not in {shown:?}");
    }
    let (_, said) = pipe;
    let lines: Vec<&str> = said.lines().filter(|line| line.contains("step p50")).collect();
    assert!(!lines.is_empty(), "{said:?}");
    assert!(!said.contains('\x1b') && !said.contains('▁'), "{said:?}");
    let (lines, _) = json;
    assert!(lines.lines().count() > 0);
    for line in lines.lines() {
        let value: serde_json::Value =
            serde_json::from_str(line).unwrap_or_else(|cause| panic!("{line}: {cause}"));
        assert!(value.is_object(), "{line}");
    }
    assert!(lines.contains("\"phase\":\"running\""), "{lines}");
}
