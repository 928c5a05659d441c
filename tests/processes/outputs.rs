//! Commands reject an output that already exists, whatever it is, before they do their work.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::process::Command;

use test_support::limited::Limited;

use crate::common::program::{Place, call, files_below, succeed, trabecula};
use crate::common::scenes;

/// Content of a file before a command.
const MINE: &[u8] = b"a user's own work";

struct Row {
    words: Vec<String>,
    /// Files that the command would write, below the test's folder.
    files: &'static [&'static str],
}

fn row(place: &Place, words: &str, files: &'static [&'static str]) -> Row {
    Row { words: place.words(words), files }
}

/// Every command with an output; `src/output.rs` compares this list with the existing commands.
fn table(place: &Place) -> Vec<Row> {
    let row = |words: &str, files| row(place, words, files);
    vec![
        row(
            "docs install -o @usr",
            &["usr/share/man/man1/trabecula-log-export.1", "usr/share/bash-completion/completions/trabecula"],
        ),
        row("drr @ball.nrrd -o @x.png", &["x.png"]),
        row("drr @ball.nrrd -o @x.nrrd", &["x.nrrd"]),
        row("drr @ball.nrrd -o @x.dcm", &["x.dcm"]),
        row("drr @ball.nrrd -o @x.png --sweep 90 --frames 3", &["x_0000.png", "x_0002.png"]),
        row("drr @ball.nrrd -o @x.png --sweep 90 --frames 3 --animate", &["x.png"]),
        row("phantom sphere -o @p.nrrd --spacing-mm 2", &["p.nrrd"]),
        row("volume drilled @log -o @d.nrrd", &["d.nrrd"]),
        row("log repair @log -o @r.mcap", &["r.mcap"]),
        row("log compress @log -o @c.mcap", &["c.mcap"]),
        row("log export @log -o @t.csv", &["t.csv"]),
        row("log export @log -o @t.parquet", &["t.parquet"]),
        row("log export @log -o @t.stl --geometry tunnel", &["t.stl"]),
        row("volume drilled @log -o @d.nii.gz", &["d.nii.gz"]),
        row("log cat-files @log @log -o @both.mcap", &["both.mcap"]),
        row("log split @two.mcap -o @runs", &["runs/run1.mcap", "runs/run2.mcap"]),
        row("sweep gather @swept -o @g.parquet", &["g.parquet"]),
        row("sweep plot @swept --of bend_deg -o @s", &["s.png", "s.svg"]),
        row(
            "identify @fit.toml -o @fit",
            &["fit/identified.toml", "fit/identification.json", "fit/report.html"],
        ),
        row("identify @fit.toml --simulate -o @plan", &["plan/pull_bend.csv"]),
        row("plot @log t_world_tip.position_m --output @f", &["f.png", "f.svg"]),
        row("replay @log --output @again", &["again/run.mcap"]),
        row(
            "calibrate @sweep.toml -o @cal",
            &["cal/calibration.csv", "cal/calibration.png", "cal/calibration.svg"],
        ),
        row("scene from-markups @plan.fcsv --ct @ball.nrrd -o @plan.toml", &["plan.toml"]),
        row("scene show @scene.toml -o @show.png", &["show.png"]),
        row("log export @log -o @view.mcap --foxglove", &["view.mcap"]),
        row("log export @log -o @coco --dataset coco", &["coco/annotations.json"]),
        row("log export @log -o @yolo --dataset yolo", &["yolo/data.yaml"]),
        row("log export @log -o @segments --dataset yolo-segment", &["segments/data.yaml"]),
        row("log export @log -o @npz --dataset npz", &["npz/dataset.json"]),
        row("scene init -o @scenes", &["scenes/femur_curved_drilling.toml"]),
        row(
            "plan path @path.toml -o @plans --candidates 1 --samples 1",
            &["plans/plan-1.toml", "plans/plans.png"],
        ),
        row("fmu export @scene.toml -o @d.fmu", &["d.fmu"]),
    ]
}

/// Creates the inputs of the commands of [`table`].
fn with_inputs() -> Place {
    let place = Place::new();
    let sweep = "tension_sweep = { most_n = 2.0, step_n = 1.0, settle_s = 0.05 }";
    fs::write(
        place.path("sweep.toml"),
        scenes::hold("lockstep", 60.0).replace("hold = { tension_n = 2.0 }", sweep),
    )
    .unwrap();
    let folder = place.complete(&scenes::drill("lockstep", 0.1)).folder;
    fs::rename(folder, place.path("log")).unwrap();
    fs::remove_dir(place.path("out")).unwrap();
    fs::write(place.path("plan.fcsv"), scenes::PLAN_OF_THE_BALL).unwrap();
    for words in ["phantom sphere -o @ball.nrrd --spacing-mm 2", "log cat-files @log @log -o @two.mcap"] {
        let done = call(&place.words(words));
        assert_eq!(done.code, Some(0), "{}", done.err);
    }
    let target = "feedback = \"none\"\ntarget_mm = [0.0, 0.0, -14.0]\n";
    let path = scenes::drill_unseen("lockstep", 3.0).replace("tension_n = 6.0\n", "tension_n = 0.0\n");
    fs::write(place.path("path.toml"), format!("{path}{target}")).unwrap();
    let study = "scene = \"scene.toml\"\ndesign = \"csv\"\npoints = \"points.csv\"\nset = [\"run.duration_s=0.01\"]\n";
    fs::write(place.path("study.toml"), study).unwrap();
    fs::write(place.path("points.csv"), "run.seed\n1\n2\n").unwrap();
    let fit = "[[parameter]]\nkey = \"manipulator.stiffness_scale\"\nmin = 0.5\nmax = 2.0\n\
        [[experiment]]\nname = \"pull\"\nscene = \"scene.toml\"\nset = [\"run.duration_s=0.01\"]\n\
        file = \"bend.csv\"\ntime = \"t\"\n\
        [[experiment.measured]]\nname = \"bend\"\nof = \"bend\"\ncolumns = [\"bend\"]\nunit = \"deg\"\n\
        noise = 0.1\nrate_hz = 200\n";
    fs::write(place.path("fit.toml"), fit).unwrap();
    fs::write(place.path("bend.csv"), "t,bend\n0.004,0.1\n0.008,0.2\n").unwrap();
    let done = call(&place.words("sweep run @study.toml -o @swept --quiet"));
    assert_eq!(done.code, Some(0), "{}", done.err);
    place
}

/// Regression: `drr` overwrote everything, including its own CT; `calibrate` overwrote its own earlier
/// output.
#[test]
fn no_command_writes_over_a_file_that_is_there() {
    let place = with_inputs();
    let before = files_below(&place.path(""));
    for row in table(&place) {
        for file in row.files {
            let file = place.path(file);
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            // A file, and a dangling link: writing through it would create a file elsewhere.
            for is_link in [false, true] {
                match is_link {
                    false => fs::write(&file, MINE).unwrap(),
                    true => std::os::unix::fs::symlink(place.path("nowhere"), &file).unwrap(),
                }
                let done = call(&row.words);
                assert_eq!(done.code, Some(2), "{:?}: {}{}", row.words, done.out, done.err);
                let name = file.file_name().unwrap().to_str().unwrap();
                assert!(
                    done.err.contains(&format!("{name}: already exists")),
                    "{:?}: {}",
                    row.words,
                    done.err
                );
                assert!(is_link || fs::read(&file).unwrap() == MINE, "{:?}", row.words);
                fs::remove_file(&file).unwrap();
                assert!(files_below(&place.path("")) == before, "{:?} has written something", row.words);
            }
        }
    }
}

/// Regression: `--json` with a path that is not UTF-8 panicked after the work was done.
#[test]
fn every_result_in_json_can_name_a_path_that_is_not_utf8() {
    let place = with_inputs();
    let folder = place.path("").join(OsStr::from_bytes(b"gr\xfcn"));
    fs::create_dir(&folder).unwrap();
    let of_runs = ["run @scene.toml -o @runs", "sweep run @study.toml --quiet -o @sweep"];
    let rows = table(&place).into_iter().map(|row| row.words);
    let mut with_the_path = 0;
    for words in rows.chain(of_runs.iter().map(|words| place.words(words))) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        for (i, word) in words.iter().enumerate() {
            match i > 0 && matches!(&*words[i - 1], "-o" | "--output") {
                true => command.arg(folder.join(Path::new(word).file_name().unwrap())),
                false => command.arg(word),
            };
        }
        let output = command.arg("--json").limited_output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        if said.contains("unexpected argument '--json'") {
            continue;
        }
        if said.contains("there is no tunnel") {
            continue;
        }
        // Rows of the table share names.
        let is_taken = said.contains("already exists");
        assert_eq!(output.status.code(), Some(if is_taken { 2 } else { 0 }), "{words:?}: {said}");
        let text = String::from_utf8(output.stdout).unwrap();
        for line in text.lines() {
            serde_json::from_str::<serde_json::Value>(line).unwrap_or_else(|_| panic!("{words:?}: {line}"));
        }
        with_the_path += usize::from(text.contains("gr\u{fffd}n"));
    }
    assert!(with_the_path >= 12, "{with_the_path} commands name the path in their result");
}

#[test]
fn no_command_writes_over_its_own_input() {
    let place = Place::new();
    let ball = place.path("ball.nrrd");
    succeed(&[&"phantom", &"sphere", &"-o", &ball, &"--spacing-mm", &"2"]);
    let before = fs::read(&ball).unwrap();
    let done = trabecula(&[&"drr", &ball, &"-o", &ball]);
    assert!(done.code == Some(2) && done.err.contains("already exists"), "{}", done.err);
    // Under another name, and a slice of a patient's series.
    std::os::unix::fs::symlink(&ball, place.path("link.nrrd")).unwrap();
    let done = trabecula(&[&"drr", &ball, &"-o", &place.path("link.nrrd")]);
    assert!(done.code == Some(2) && done.err.contains("already exists"), "{}", done.err);
    assert!(fs::read(&ball).unwrap() == before);
    let slice = place.path("series/007.dcm");
    fs::create_dir(place.path("series")).unwrap();
    fs::write(&slice, MINE).unwrap();
    let done = trabecula(&[&"drr", &place.path("series"), &"-o", &slice]);
    assert!(done.code == Some(2) && done.err.contains("already exists"), "{}", done.err);
    assert_eq!(fs::read(&slice).unwrap(), MINE);
}

/// The names of exported pictures are known only when they are written: existing ones stay, and those of this
/// command are removed.
#[test]
fn exported_pictures_replace_none_and_leave_none_of_a_refused_export() {
    let place = Place::new();
    let log = place.complete(&scenes::drill("lockstep", 0.4)).folder;
    let pictures = place.path("pictures");
    let export = || trabecula(&[&"log", &"export", &log, &"--frames", &"-o", &pictures]);
    assert_eq!(export().code, Some(0));
    let all = files_below(&pictures);
    assert!(all.len() > 2, "{}", all.len());
    let (last, others) = all.split_last().unwrap();
    others.iter().for_each(|(name, _)| fs::remove_file(pictures.join(name)).unwrap());
    fs::write(pictures.join(&last.0), MINE).unwrap();
    let done = export();
    assert!(done.code == Some(2) && done.err.contains("already exists"), "{}", done.err);
    assert!(files_below(&pictures) == [(last.0.clone(), MINE.to_vec())]);
}
