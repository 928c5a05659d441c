//! Command output: a failed write to standard output is a failure, except when the reader has closed the
//! pipe.

use std::fs::{self, File};
use std::process::{Command, Output, Stdio};

use test_support::limited::limited_output_of;

use crate::common::program::{LIMIT, Place, succeed};
use crate::common::scenes;

/// How a command of the program's command table is called here.
enum Call {
    /// With these arguments; `@` is replaced by the test's folder, `#` by a number unique to this call.
    As(&'static str),
    /// Only with `--help`.
    HelpOnly,
}

fn call(command: &str) -> Call {
    use Call::{As, HelpOnly};
    match command {
        "run" => As("run @scene.toml --output @out --quiet"),
        "replay" => As("replay @log --verify"),
        "plot" => As("plot @log t_world_tip.position_m --output @f#"),
        "log info" => As("log info @log"),
        "log cat" => As("log cat @log"),
        "log diff" => As("log diff @log @log"),
        "log repair" => As("log repair @log -o @r#.mcap"),
        "log compress" => As("log compress @log -o @c#.mcap"),
        "log export" => As("log export @log -o @t#.csv"),
        "log cat-files" => As("log cat-files @log @log -o @both#.mcap"),
        "log split" => As("log split @two.mcap -o @runs#"),
        "calibrate" => As("calibrate @sweep.toml -o @cal#"),
        // It simulates for minutes: `tests/processes/plan_paths.rs`.
        "plan path" => HelpOnly,
        "device list" => As("device list"),
        "device mapping" => As("device mapping pedal"),
        "scene check" => As("scene check @scene.toml"),
        "scene from-markups" => As("scene from-markups @plan.fcsv --ct @ball.nrrd -o @p#.toml"),
        "scene show" => As("scene show @ball.toml -o @show#.png"),
        "scene schema" => As("scene schema"),
        "scene init" => As("scene init -o @scenes#"),
        "volume info" => As("volume info @ball.nrrd"),
        "volume probe" => As("volume probe @ball.nrrd --at 0,0,0"),
        "volume drilled" => As("volume drilled @log -o @d#.nrrd"),
        "fmu export" => As("fmu export @scene.toml -o @d#.fmu"),
        // It needs a running session.
        "fmu drive" => HelpOnly,
        // It needs a study: `tests/processes/outputs.rs`.
        "identify" => HelpOnly,
        "phantom" => As("phantom sphere -o @p#.nrrd --spacing-mm 2"),
        "drr" => As("drr @ball.nrrd -o @x#.png"),
        "docs messages" => As("docs messages"),
        "docs scene" => As("docs scene"),
        "docs schema" => As("docs schema State"),
        "docs completions" => As("docs completions zsh"),
        "docs man" => As("docs man"),
        "docs install" => As("docs install -o @usr#"),
        "doctor" => As("doctor"),
        "session list" => As("session list"),
        // It would remove what other runs on this machine need: `tests/processes/cache.rs`.
        "cache clear" => HelpOnly,
        "cache info" => As("cache info"),
        "tool show" => As("tool show @scene.toml"),
        // They need a running session: `tests/processes/session_commands.rs`.
        "session stop" | "session pause" | "session resume" | "session save" | "session env" => HelpOnly,
        // These end only on request or take minutes, and a part of a session has no user to answer. All write
        // through `src/say.rs`: a lint rejects any other access to standard output.
        "view" | "stress" => HelpOnly,
        // Covered by `tests/processes/sweeps.rs`.
        _ if command.starts_with("sweep ") => HelpOnly,
        _ if ["bridge ", "device ", "proc "].iter().any(|group| command.starts_with(group)) => HelpOnly,
        unknown => panic!("`{unknown}` is new: say here how it is called"),
    }
}

/// Returns the subcommands of a command, as its help lists them.
fn commands(above: &str) -> Vec<String> {
    let words: Vec<&str> = above.split(' ').filter(|word| !word.is_empty()).collect();
    let output = run(&[&words[..], &["--help"]].concat(), Stdio::piped());
    let help = String::from_utf8(output.stdout).unwrap();
    let listed = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    let names = listed.take_while(|line| !line.is_empty()).filter(|line| !line.starts_with("   "));
    let names = names.filter_map(|line| line.split_whitespace().next()).filter(|name| *name != "help");
    let below: Vec<String> = names.map(|name| format!("{above} {name}").trim().to_owned()).collect();
    if below.is_empty() {
        return vec![above.to_owned()];
    }
    below.iter().flat_map(|command| commands(command)).collect()
}

fn run(words: &[&str], out: Stdio) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.args(words).stdin(Stdio::null()).stdout(out).stderr(Stdio::piped());
    limited_output_of(command.spawn().unwrap(), LIMIT, &words.join(" "))
}

fn full() -> Stdio {
    File::options().write(true).open("/dev/full").unwrap().into()
}

/// A pipe whose reader has closed, as behind `| head`.
fn closed() -> Stdio {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    writer.into()
}

const UNWRITTEN: &str = "cannot write to standard output (No space left on device";

fn assert_told(words: &[&str]) {
    let output = run(words, full());
    let err = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{words:?} > /dev/full: {err}");
    assert_eq!(err.matches(UNWRITTEN).count(), 1, "{words:?}: {err}");
}

/// Regression: `log info`, `log diff`, `replay --verify`, `volume info`, `scene check`, `doctor`, `run
/// --json` and most others ended with 0 although their output was lost.
#[test]
fn an_answer_that_cannot_be_written_ends_with_1_whatever_the_command() {
    let place = Place::new();
    let sweep = "tension_sweep = { most_n = 2.0, step_n = 1.0, settle_s = 0.05 }";
    let scene = scenes::hold("lockstep", 60.0).replace("hold = { tension_n = 2.0 }", sweep);
    fs::write(place.path("sweep.toml"), scene).unwrap();
    let folder = place.complete(&scenes::drill("lockstep", 0.2)).folder;
    fs::rename(folder, place.path("log")).unwrap();
    let (log, ball, two) = (place.path("log"), place.path("ball.nrrd"), place.path("two.mcap"));
    succeed(&[&"phantom", &"sphere", &"-o", &ball, &"--spacing-mm", &"2"]);
    let (plan, planned) = (place.path("plan.fcsv"), place.path("ball.toml"));
    fs::write(&plan, scenes::PLAN_OF_THE_BALL).unwrap();
    succeed(&[&"scene", &"from-markups", &plan, &"--ct", &ball, &"-o", &planned]);
    succeed(&[&"log", &"cat-files", &log, &log, &"-o", &two]);
    let here = place.path("");
    let here = here.to_str().unwrap();
    let mut number = 0;
    let mut fresh = |words: &str| -> Vec<String> {
        number += 1;
        words.split(' ').map(|word| word.replace('@', here).replace('#', &number.to_string())).collect()
    };
    let all = commands("");
    assert!(all.len() > 30, "{all:?}");
    let mut lines: Vec<&str> = Vec::new();
    for command in &all {
        assert_told(&[&command.split(' ').collect::<Vec<_>>()[..], &["--help"]].concat());
        if let Call::As(words) = call(command) {
            lines.push(words);
        }
    }
    lines.extend(["plan @scene.toml", "run @scene.toml --output @out --json"]);
    for line in lines {
        let told = fresh(line);
        let told: Vec<&str> = told.iter().map(String::as_str).collect();
        assert_told(&told);
        let (heard, unheard) = (fresh(line), fresh(line));
        let output = run(&heard.iter().map(String::as_str).collect::<Vec<_>>(), Stdio::piped());
        let err = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(0) && !output.stdout.is_empty(), "{line}: {err}");
        let output = run(&unheard.iter().map(String::as_str).collect::<Vec<_>>(), closed());
        let err = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(0) && !err.contains("standard output"), "{line} | head: {err}");
    }
    assert_told(&["--version"]);
    assert_told(&["--help"]);
}
