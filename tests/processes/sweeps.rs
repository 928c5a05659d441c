//! `trabecula sweep`: rows compared with the runs of their commands, interruptions, workflow engines on other
//! machines.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use rustix::process::{Pid, Signal};
use serde_json::Value;
use test_support::limited::{Limited, limited_output_of};
use test_support::python::or_skip;

use crate::common::program::{
    Done, Guarded, LIMIT, Place, as_words, call, only_entry, processes_with, signal, succeed, trabecula,
    wait_for,
};
use crate::python::python;

/// A tool held by its tendon in a block of bone, for a short time.
const SCENE: &str = "name = \"swept\"\n[run]\nmode = \"lockstep\"\nduration_s = 0.2\n[volume]\nphantom = \"block\"\nspacing_mm = 1.0\n\
     bone_threshold_hu = 150\n[tool]\nburr_start_mm = [0.0, 0.0, -80.0]\ndirection = [0.0, 0.0, 1.0]\n\
     bend_toward = [1.0, 0.0, 0.0]\n[[controller]]\nname = \"holder\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nhold = { tension_n = 1.0 }\n";

const STUDY: &str = "scene = \"scene.toml\"\ndesign = \"latin_hypercube\"\nsamples = 8\nseed = 3\n\
     [[parameter]]\nkey = \"controller.0.hold.tension_n\"\nmin = 0.5\nmax = 6.0\n\
     [[parameter]]\nkey = \"manipulator.tendon_friction\"\nmin = 0.0\nmax = 0.4\n";

/// Creates a study in a folder; each row takes long enough to be interrupted if `slow`.
fn study(place: &Place, text: &str) -> PathBuf {
    place.scene(SCENE);
    let file = place.path("study.toml");
    fs::write(&file, text).unwrap();
    file
}

fn sweep(words: &[&dyn AsRef<std::ffi::OsStr>]) -> Done {
    trabecula(&[&[&"sweep" as &dyn AsRef<std::ffi::OsStr>], words].concat())
}

fn run(study: &Path, folder: &Path, more: &[&str]) -> Done {
    let more = as_words(more);
    sweep(&[&[&"run" as &dyn AsRef<std::ffi::OsStr>, &study, &"-o", &folder, &"--quiet"], &more[..]].concat())
}

fn complete(study: &Path, folder: &Path, more: &[&str]) -> Done {
    let done = run(study, folder, more);
    assert_eq!(done.code, Some(0), "{}", done.err);
    done
}

/// Returns names and contents of the rows.
fn rows(folder: &Path) -> Vec<(String, Value)> {
    let mut rows: Vec<(String, Value)> = fs::read_dir(folder.join("rows"))
        .unwrap()
        .flatten()
        .map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            (name, serde_json::from_slice(&fs::read(entry.path()).unwrap()).unwrap())
        })
        .collect();
    rows.sort_by(|a, b| a.0.cmp(&b.0));
    rows
}

/// Returns the arguments of a row's command, with this build's program.
fn words_of(row: &Value) -> Vec<String> {
    let words = shlex::split(row["command"].as_str().unwrap()).unwrap();
    assert_eq!(words[..2], ["trabecula", "run"]);
    words[1..].to_vec()
}

#[test]
fn a_row_has_the_hash_of_its_own_command_and_what_its_summary_says() {
    let place = Place::new();
    let study = study(&place, &STUDY.replace("samples = 8", "samples = 2\nrecord = \"all\""));
    let folder = place.path("swept");
    complete(&study, &folder, &[]);
    let rows = rows(&folder);
    assert_eq!(rows.len(), 2);
    assert_ne!(rows[0].1["final_hash"], rows[1].1["final_hash"]);
    for (_, row) in &rows {
        assert_eq!((&row["outcome"], &row["ticks"]), (&"completed".into(), &200.into()), "{row}");
        let out = place.path(&format!("out{}", row["point"]));
        let words: Vec<String> = [words_of(row), vec!["-o".to_owned(), out.display().to_string()]].concat();
        let done = call(&words);
        assert_eq!(done.code, Some(0), "{}", done.err);
        let summary: Value =
            serde_json::from_slice(&fs::read(only_entry(&out).join("summary.json")).unwrap()).unwrap();
        for field in ["final_hash", "ticks", "simulated_s", "tool", "drilling"] {
            assert_eq!(row[field], summary[field], "{field}");
        }
        let log = folder.join(row["log"].as_str().unwrap());
        succeed(&[&"replay", &log, &"--verify"]);
    }
}

#[test]
fn jobs_shards_and_single_points_give_the_rows_of_one_process() {
    let place = Place::new();
    let study = study(&place, STUDY);
    let whole = place.path("whole");
    complete(&study, &whole, &["--jobs", "1"]);
    let others = [place.path("jobs"), place.path("shards"), place.path("points")];
    complete(&study, &others[0], &["--jobs", "3"]);
    for shard in ["2/3", "0/3", "1/3"] {
        complete(&study, &others[1], &["--shard", shard]);
    }
    let listed = sweep(&[&"list", &study, &"-o", &others[2]]);
    assert!(!others[2].exists(), "a list writes nothing");
    let commands: Vec<&str> = listed.out.lines().collect();
    assert_eq!(commands.len(), 8);
    for command in commands.iter().rev() {
        let output = Command::new("sh").args(["-c", command]).current_dir("/").limited_output().unwrap();
        assert!(output.status.success(), "{command}: {}", String::from_utf8_lossy(&output.stderr));
    }
    for other in &others {
        assert_eq!(rows(other), rows(&whole), "{}", other.display());
    }
    let names: Vec<PathBuf> = ["a.parquet", "b.parquet"].map(|name| place.path(name)).to_vec();
    assert_eq!(sweep(&[&"gather", &whole, &"-o", &names[0]]).code, Some(0));
    assert_eq!(sweep(&[&"gather", &others[2], &others[1], &"-o", &names[1]]).code, Some(0));
    assert!(fs::read(&names[0]).unwrap() == fs::read(&names[1]).unwrap());
    assert!(fs::read(&names[0]).unwrap() == fs::read(whole.join("table/shard-0-of-1.parquet")).unwrap());
}

/// Runs that take seconds each, so that a signal arrives during one.
fn slow(place: &Place) -> PathBuf {
    study(place, &STUDY.replace("seed = 3", "seed = 3\nset = [\"run.duration_s=5.0\"]"))
}

fn start(study: &Path, folder: &Path) -> Guarded {
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.args(["sweep", "run"]).arg(study).arg("-o").arg(folder).args(["--jobs", "1", "--quiet"]);
    Guarded(command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap())
}

fn row_count(folder: &Path) -> usize {
    let whole = |name: &str| name.len() == "0000000.json".len() && name.ends_with(".json");
    let entries = fs::read_dir(folder.join("rows")).into_iter().flatten().flatten();
    entries.filter(|entry| whole(&entry.file_name().to_string_lossy())).count()
}

#[test]
fn a_sweep_that_was_interrupted_or_killed_goes_on_and_ends_with_the_same_rows() {
    let place = Place::new();
    let study = slow(&place);
    let (whole, ended) = (place.path("whole"), place.path("ended"));
    let mut interrupted = start(&study, &ended);
    wait_for("the first row", || (row_count(&ended) > 0).then_some(()));
    signal(interrupted.0.id(), Signal::INT);
    let output = limited_output_of(take(&mut interrupted), LIMIT, "an interrupted sweep");
    assert_eq!(output.status.code(), Some(130), "{}", String::from_utf8_lossy(&output.stderr));
    let after = row_count(&ended);
    assert!((1..8).contains(&after), "{after}");
    assert!(ended.join("table/shard-0-of-1.parquet").exists(), "what is done has its table");
    let killed = start(&study, &ended);
    wait_for("the next row", || (row_count(&ended) > after).then_some(()));
    drop(killed);
    complete(&study, &ended, &[]);
    complete(&study, &whole, &[]);
    assert_eq!(rows(&ended), rows(&whole));
    let tables = [&ended, &whole].map(|folder| fs::read(folder.join("table/shard-0-of-1.parquet")).unwrap());
    assert!(tables[0] == tables[1]);
}

/// Takes the child out of a guard, replacing it by one that has ended.
fn take(guarded: &mut Guarded) -> Child {
    let ended = Command::new("true").stdout(Stdio::null()).spawn().unwrap();
    std::mem::replace(&mut guarded.0, ended)
}

#[test]
fn controllers_that_are_programs_run_as_sessions_and_others_started_elsewhere_are_refused() {
    let place = Place::new();
    let study = study(
        &place,
        &STUDY
            .replace("samples = 8", "samples = 2")
            .replace("controller.0.hold.tension_n", "contact.friction")
            .replace("min = 0.5\nmax = 6.0", "min = 0.1\nmax = 0.5"),
    );
    let scene = SCENE.replace(
        "hold = { tension_n = 1.0 }",
        "command = [\"sh\", \"-c\", \"exit 3\"]\nconnect_limit_s = 20",
    );
    fs::write(place.path("scene.toml"), scene).unwrap();
    let folder = place.path("swept");
    complete(&study, &folder, &[]);
    let found = rows(&folder);
    assert_eq!(found.len(), 2);
    assert!(
        found.iter().all(|(_, row)| row["outcome"] == "failed" && row["reason"].is_string()),
        "{found:?}"
    );
    fs::write(place.path("scene.toml"), SCENE.replace("hold = { tension_n = 1.0 }", "external = true"))
        .unwrap();
    let done = run(&study, &place.path("other"), &[]);
    assert_eq!(done.code, Some(2), "{}", done.err);
    assert!(
        done.err.contains("controller `holder` is external, and a sweep cannot start it"),
        "{}",
        done.err
    );
    assert!(!place.path("other").exists(), "a refused sweep writes nothing");
}

/// Regression: the runs of a killed sweep went on, and the same command, given again, had twice as many.
#[test]
fn the_runs_of_a_killed_sweep_end_with_it() {
    let place = Place::new();
    let text = STUDY
        .replace("seed = 3", "seed = 3\nset = [\"run.duration_s=600.0\", \"run.mode='realtime'\"]")
        .replace("controller.0.hold.tension_n", "contact.friction")
        .replace("min = 0.5\nmax = 6.0", "min = 0.1\nmax = 0.5");
    let study = study(&place, &text);
    let program = "command = [\"sleep\", \"600\"]\nconnect_limit_s = 600";
    fs::write(place.path("scene.toml"), SCENE.replace("hold = { tension_n = 1.0 }", program)).unwrap();
    let folder = place.path("swept");
    let sweep = start(&study, &folder);
    // The launcher of a run and its recorder name the folder of the run.
    let runs = format!("{}/runs/", folder.display());
    let of_runs = || processes_with(std::slice::from_ref(&runs)).len();
    wait_for("a run with its recorder", || (of_runs() >= 2).then_some(()));
    drop(sweep);
    wait_for("the end of the runs", || (of_runs() == 0).then_some(()));
}

/// Regression: a row that is a link to `/dev/zero` filled the memory, a pipe was waited for, and a count of
/// 2^64 - 1 was counted to.
#[test]
fn a_folder_from_elsewhere_is_read_with_limits() {
    let place = Place::new();
    let study = study(&place, &STUDY.replace("samples = 8", "samples = 2"));
    let folder = place.path("swept");
    complete(&study, &folder, &[]);
    let (row, table, figure) =
        (folder.join("rows/0000000.json"), place.path("table.parquet"), place.path("figure"));
    let refused = |why: &str| {
        let commands: [&[&dyn AsRef<std::ffi::OsStr>]; 3] = [
            &[&"report", &folder, &"--of", &"bend_deg"],
            &[&"plot", &folder, &"--of", &"bend_deg", &"-o", &figure],
            &[&"gather", &folder, &"-o", &table],
        ];
        for command in commands {
            let done = sweep(command);
            assert!(matches!(done.code, Some(1 | 2)) && done.err.contains(why), "{why}: {done:?}");
            assert!(!table.exists() && !place.path("figure.png").exists(), "{why}: written");
        }
    };
    let whole = fs::read(&row).unwrap();
    fs::remove_file(&row).unwrap();
    std::os::unix::fs::symlink("/dev/zero", &row).unwrap();
    refused("0000000.json: not a regular file");
    fs::remove_file(&row).unwrap();
    rustix::fs::mkfifoat(rustix::fs::CWD, &row, rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR).unwrap();
    refused("0000000.json: not a regular file");
    fs::remove_file(&row).unwrap();
    fs::File::create(&row).unwrap().set_len(1 << 34).unwrap();
    refused("0000000.json: longer than 1048576 bytes");
    fs::write(&row, whole).unwrap();
    let identity = folder.join("study.json");
    let text = fs::read_to_string(&identity).unwrap();
    fs::write(&identity, text.replace("\"count\": 2", "\"count\": 18446744073709551615")).unwrap();
    refused("study.json: `count` is 18446744073709551615, but its study has 2 points");
    fs::write(&identity, text.replace("manipulator.tendon_friction\"", "run.seed\"")).unwrap();
    refused("study.json");
}

/// Regression: the page on data sets exported logs of a sweep, and they had no frames.
#[test]
fn a_sweep_that_records_frames_makes_a_data_set() {
    let place = Place::new();
    let by_angle = STUDY
        .replace("samples = 8", "samples = 2\nrecord = \"frames\"")
        .replace("controller.0.hold.tension_n", "drr.primary_angle_deg")
        .replace("min = 0.5\nmax = 6.0", "min = -60.0\nmax = 60.0");
    let study = study(&place, &by_angle);
    let x_ray = "[drr]\nrate_hz = 10.0\nisocentre_mm = [0.0, 0.0, -40.0]\ncolumns = 48\nrows = 32\npixel_pitch_mm = 5.0\n[[controller]]";
    fs::write(place.path("scene.toml"), SCENE.replace("[[controller]]", x_ray)).unwrap();
    let folder = place.path("swept");
    complete(&study, &folder, &[]);
    let logs: Vec<PathBuf> =
        rows(&folder).iter().map(|(_, row)| folder.join(row["log"].as_str().unwrap())).collect();
    let output = place.path("dataset");
    let done = trabecula(&[&"log", &"export", &logs[0], &logs[1], &"-o", &output, &"--dataset", &"coco"]);
    assert_eq!(done.code, Some(0), "{}{}", done.out, done.err);
    let frames = fs::read_dir(output.join("images")).unwrap().count();
    assert!(frames >= 4 && frames.is_multiple_of(2), "{frames}");
}

#[test]
fn a_report_finds_what_a_figure_depends_on_and_pandas_opens_the_dataset() {
    let place = Place::new();
    let text = STUDY.replace("latin_hypercube", "saltelli").replace("samples = 8", "samples = 16");
    let study = study(&place, &text);
    let folder = place.path("swept");
    complete(&study, &folder, &[]);
    let done = sweep(&[&"report", &folder, &"--of", &"bend_deg", &"--json"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let report: Value = serde_json::from_str(&done.out).unwrap();
    let parameters = report["figures"][0]["parameters"].as_array().unwrap();
    let total = |place: usize| parameters[place]["sobol"]["total"].as_f64().unwrap();
    // Bend follows tension; a friction of 0.4 reduces it by a few per cent.
    assert!(total(0) > 0.8 && total(1) < 0.2, "{report}");
    assert!(parameters[0]["rank_correlation"].as_f64().unwrap() > 0.9, "{report}");
    let text = sweep(&[&"report", &folder, &"--of", &"bend_deg"]).out;
    assert!(text.contains("controller.0.hold.tension_n") && text.contains("first order"), "{text}");
    let picture = place.path("bend");
    assert_eq!(sweep(&[&"plot", &folder, &"--of", &"bend_deg", &"-o", &picture]).code, Some(0));
    assert!(place.path("bend.png").exists() && place.path("bend.svg").exists());
    assert_eq!(sweep(&[&"plot", &folder, &"--of", &"bend_deg", &"-o", &picture]).code, Some(2));
    let Some(python) = python() else { return };
    let script = "import sys, pandas, polars\n\
        a = pandas.read_parquet(sys.argv[1])\n\
        b = polars.read_parquet(sys.argv[1] + '/*.parquet')\n\
        assert list(a.columns) == b.columns and len(a) == len(b) == 64\n\
        assert a['final_hash'].nunique() == 64 and a['target_error_mm'].isna().all()\n\
        assert (a['outcome'] == 'completed').all() and a['reason'].isna().all()\n\
        assert a['bend_deg'].corr(a['controller.0.hold.tension_n']) > 0.9\n";
    let output =
        Command::new(python).args(["-c", script]).arg(folder.join("table")).limited_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn engine(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/sweep/engines").join(name)
}

/// Returns the rows computed on a single machine, which an engine's must equal.
fn single(place: &Place, study: &Path) -> Vec<(String, Value)> {
    let whole = place.path("single");
    complete(study, &whole, &[]);
    rows(&whole)
}

/// Returns a worker of an engine that performs a run: the parent of one of our processes below the engine's.
fn worker_below(root: u32) -> Option<u32> {
    let below = ipc_types::process::descendants(Pid::from_raw(root as i32)?);
    below.into_iter().map(|pid| pid.as_raw_nonzero()).find_map(|pid| {
        let line = fs::read(format!("/proc/{pid}/cmdline")).ok()?;
        let words: Vec<&[u8]> = line.split(|byte| *byte == 0).collect();
        let is_run =
            words.len() > 2 && words[0] == env!("CARGO_BIN_EXE_trabecula").as_bytes() && words[2] == b"run";
        let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok().filter(|_| is_run)?;
        stat.rsplit_once(')')?.1.split_whitespace().nth(1)?.parse().ok()
    })
}

/// Runs an engine's script, and kills one of its workers in the middle.
fn with_a_killed_worker(mut command: Command, folder: &Path) {
    let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let root = child.id();
    let worker = wait_for("a worker's run", || worker_below(root).filter(|_| row_count(folder) > 0));
    signal(worker, Signal::KILL);
    let output = limited_output_of(child, 3 * LIMIT, "an engine");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn dask_gives_the_rows_of_one_machine_though_a_worker_is_killed() {
    let Some(python) = or_skip("dask-1", &["dask==2026.8.0", "distributed==2026.8.0"], "dask.distributed")
    else {
        return;
    };
    let place = Place::new();
    let study = slow(&place);
    let expected = single(&place, &study);
    let folder = place.path("dask");
    let mut command = Command::new(python);
    command.arg(engine("dask_run.py")).arg(env!("CARGO_BIN_EXE_trabecula")).arg(&study).arg(&folder);
    with_a_killed_worker(command, &folder);
    assert_eq!(rows(&folder), expected);
}

#[test]
fn ray_gives_the_rows_of_one_machine_though_a_worker_is_killed() {
    let Some(python) = or_skip("ray-1", &["ray==2.60.0"], "ray") else { return };
    let place = Place::new();
    let study = slow(&place);
    let expected = single(&place, &study);
    let folder = place.path("ray");
    let mut command = Command::new(python);
    command.arg(engine("ray_run.py")).arg(env!("CARGO_BIN_EXE_trabecula")).arg(&study).arg(&folder);
    with_a_killed_worker(command, &folder);
    assert_eq!(rows(&folder), expected);
}

/// Its workers are threads of the script, so none is killed.
#[test]
fn hyperqueue_gives_the_rows_of_one_machine() {
    let Some(python) = or_skip("hyperqueue-1", &["hyperqueue==0.27.0"], "hyperqueue") else { return };
    let place = Place::new();
    let study = study(&place, STUDY);
    let expected = single(&place, &study);
    let folder = place.path("hyperqueue");
    let mut command = Command::new(python);
    command.arg(engine("hyperqueue_run.py")).arg(env!("CARGO_BIN_EXE_trabecula")).arg(&study).arg(&folder);
    let output = command.current_dir(place.path("")).limited_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(rows(&folder), expected);
}

#[test]
fn slurm_array_jobs_give_the_rows_of_one_machine() {
    let place = Place::new();
    let study = study(&place, STUDY);
    let expected = single(&place, &study);
    let folder = place.path("slurm");
    for job in ["3", "1", "0", "2", "1"] {
        let mut command = Command::new(engine("slurm.sh"));
        command.arg(env!("CARGO_BIN_EXE_trabecula")).arg(&study).arg(&folder);
        command.envs([
            ("SLURM_ARRAY_TASK_ID", job),
            ("SLURM_ARRAY_TASK_COUNT", "4"),
            ("SLURM_CPUS_PER_TASK", "2"),
        ]);
        let output = command.limited_output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    assert_eq!(rows(&folder), expected);
}
