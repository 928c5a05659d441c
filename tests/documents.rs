//! Checks that the documents agree with the code, and that their links are valid.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail the test")]

use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(name: impl AsRef<Path>) -> String {
    let path = root().join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|cause| panic!("{}: {cause}", path.display()))
}

fn documents() -> Vec<PathBuf> {
    let in_docs = std::fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let pages = in_docs.filter(|path| path.extension().is_some_and(|extension| extension == "md"));
    let others = ["README.md", "ARCHITECTURE.md", ".github/CONTRIBUTING.md", ".github/SECURITY.md"];
    pages.chain(others.map(|name| root().join(name))).collect()
}

/// Returns the module documentation of a source file, without its markers.
fn module_doc(source: &str) -> Vec<String> {
    let lines = source.lines().map_while(|line| line.strip_prefix("//!"));
    lines.map(|line| line.trim().to_owned()).filter(|line| !line.is_empty()).collect()
}

/// Returns the `text` blocks of a page, line by line.
fn text_blocks(page: &str) -> Vec<Vec<String>> {
    let blocks = page.split("\n```text\n").skip(1).filter_map(|rest| rest.split("\n```").next());
    blocks.map(|block| block.lines().map(|line| line.trim().to_owned()).collect()).collect()
}

#[test]
fn the_tick_of_the_architecture_is_that_of_the_code() {
    let blocks = text_blocks(&read("ARCHITECTURE.md"));
    for (source, first) in
        [("crates/hub/src/lib.rs", "connect:"), ("crates/simulation/src/world/mod.rs", "1. apply")]
    {
        let block = blocks.iter().find(|block| block[0].starts_with(first));
        let block =
            block.unwrap_or_else(|| panic!("ARCHITECTURE.md has no block that begins with `{first}`"));
        let doc = module_doc(&read(source));
        let found = doc.windows(block.len()).any(|window| window == block);
        assert!(
            found,
            "ARCHITECTURE.md's block from `{first}` is not the module documentation of {source}:\n{doc:#?}"
        );
    }
}

#[test]
fn every_link_of_the_documents_leads_to_a_file() {
    for page in documents() {
        let text = std::fs::read_to_string(&page).unwrap();
        for link in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let file = link.split('#').next().unwrap_or_default();
            if !file.is_empty() && !link.contains("://") {
                let target = page.parent().unwrap().join(file);
                assert!(target.exists(), "{}: the link `{link}` leads nowhere", page.display());
            }
        }
    }
}

#[test]
fn every_scene_that_the_documents_name_is_there() {
    for page in documents() {
        let text = std::fs::read_to_string(&page).unwrap();
        for rest in text.split("configs/").skip(1) {
            let end = rest
                .find(|c: char| !(c.is_ascii_alphanumeric() || c == '_' || c == '.'))
                .unwrap_or(rest.len());
            let name = rest[..end].trim_end_matches('.');
            assert!(
                root().join("configs").join(name).exists(),
                "{}: no scene configs/{name}",
                page.display()
            );
        }
    }
}

/// Regression: they said half a second in one place and four in another.
#[test]
fn the_documents_say_how_much_the_recorders_queues_hold() {
    use ipc_types::messages::services::{FRAME, LATCHED, RECORDER_QUEUE_TICKS, REMOVED, STATE, TICK_TIMING};
    for once_a_tick in [STATE, LATCHED, REMOVED, TICK_TIMING] {
        assert_eq!(once_a_tick.lossless_length as u64, RECORDER_QUEUE_TICKS, "{}", once_a_tick.name);
    }
    let logs = read("docs/logs.md");
    let figure = format!(
        "{RECORDER_QUEUE_TICKS} ticks, {:.1} s at 1 kHz, and {} frames",
        RECORDER_QUEUE_TICKS as f64 * 1e-3,
        FRAME.lossless_length
    );
    assert!(logs.contains(&figure), "docs/logs.md does not say `{figure}`");
    for path in documents().iter().filter(|path| !path.ends_with("CHANGELOG.md")) {
        for paragraph in
            read(path).split("\n\n").filter(|text| text.contains("recorder") && text.contains("queue"))
        {
            let text = paragraph.replace('\n', " ");
            for other in ["half a second", "four seconds"] {
                assert!(!text.contains(other), "{} says `{other}`: {text}", path.display());
            }
        }
    }
}

/// Returns the folder of each package of the workspace.
fn packages() -> Vec<(String, PathBuf)> {
    let manifest = read("Cargo.toml");
    let (members, _) = manifest.split_once("\nmembers = [").unwrap().1.split_once("\n]").unwrap();
    let folders: Vec<PathBuf> =
        members.split('"').skip(1).step_by(2).map(|folder| root().join(folder)).collect();
    assert!(folders.len() > 25, "{folders:?}");
    folders
        .into_iter()
        .map(|folder| {
            let manifest = read(folder.join("Cargo.toml"));
            let (_, package) = manifest.split_once("[package]").unwrap();
            let name = package.lines().find_map(|line| line.strip_prefix("name = ")).unwrap();
            (name.trim_matches('"').to_owned(), folder)
        })
        .collect()
}

/// Returns whether a folder has a target of this kind: `tests`, `examples` or `src/bin`.
fn has_target(folder: &Path, kind: &str, name: &str) -> bool {
    let place = folder.join(kind);
    let own = kind == "src/bin" && read(folder.join("Cargo.toml")).contains(&format!("name = \"{name}\""));
    own || place.join(format!("{name}.rs")).exists() || place.join(name).join("main.rs").exists()
}

#[test]
fn every_package_test_and_program_that_the_documents_call_is_there() {
    let packages = packages();
    for page in documents() {
        let text = std::fs::read_to_string(&page).unwrap();
        for command in text.split(['`', '\n']).filter(|piece| piece.starts_with("cargo ")) {
            let words: Vec<&str> = command.split_whitespace().collect();
            let after =
                |flag: &str| words.iter().position(|word| *word == flag).and_then(|at| words.get(at + 1));
            let name = after("-p").copied().unwrap_or("trabecula");
            let package = packages.iter().find(|(package, _)| package == name);
            let Some((_, folder)) = package else {
                panic!("{}: `{command}` names no package of ours", page.display())
            };
            for (flag, kind) in [("--test", "tests"), ("--example", "examples"), ("--bin", "src/bin")] {
                let Some(target) = after(flag) else { continue };
                assert!(has_target(folder, kind, target), "{}: `{command}`: no {target}", page.display());
            }
        }
    }
}

#[test]
fn every_file_that_the_guides_for_changing_it_name_is_there() {
    for page in ["ARCHITECTURE.md", ".github/CONTRIBUTING.md"] {
        let text = read(page);
        let named = text.split('`').skip(1).step_by(2).filter(|name| {
            let is_path = name.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c));
            is_path && name.contains('/') && Path::new(name).extension().is_some()
        });
        let missing: Vec<&str> = named.filter(|name| !root().join(name).exists()).collect();
        assert!(missing.is_empty(), "{page} names files that are not there: {missing:?}");
    }
}

/// Returns the integer constants of a source file, as written.
fn constants(path: &str) -> Vec<(String, String)> {
    let text = read(path);
    let mut found = Vec::new();
    for rest in text.split("const ").skip(1) {
        let Some((head, value)) = rest.split_once(" = ") else { continue };
        let Some((name, kind)) = head.split_once(": ") else { continue };
        if ["usize", "u32", "u64", "i64"].contains(&kind) {
            let value = value.split(';').next().unwrap_or_default();
            found.push((name.to_owned(), value.to_owned()));
        }
    }
    found
}

/// Returns the value of a sum, product or shift of integers and constants of the same file.
fn value(path: &str, expression: &str) -> u64 {
    let expression = expression.trim();
    let parts = |operator: &str| expression.rsplit_once(operator);
    if let Some((left, right)) = parts(" << ") {
        value(path, left) << value(path, right)
    } else if let Some((left, right)) = parts(" + ") {
        value(path, left) + value(path, right)
    } else if let Some((left, right)) = parts(" * ") {
        value(path, left) * value(path, right)
    } else if let Ok(number) = expression.replace('_', "").parse() {
        number
    } else {
        let constant = constants(path).into_iter().find(|(name, _)| name == expression);
        let (_, own) = constant.unwrap_or_else(|| panic!("{path}: no constant `{expression}`"));
        value(path, &own)
    }
}

/// Constants that are named like capacities but do not limit users: a method's working memory, times, values
/// derived from a listed constant, limits of what a report or a terminal shows.
const NO_CAPACITIES: &[(&str, &str)] = &[
    ("LONGEST", "ipc_types/src/session/folder.rs"),
    ("LONGEST_GAP", "crates/run_log/src/gaps.rs"),
    ("LONGEST_LOOK_NS", "crates/hub/src/patience.rs"),
    ("LONGEST_NS", "src/report/distribution.rs"),
    ("LONGEST_STRIDE_NS", "crates/viewer_proc/src/log/playback.rs"),
    ("MAX_BACKLOG_STEPS", "crates/viewer_proc/src/live/control.rs"),
    ("MAX_CONTACTS", "crates/simulation/src/manipulator/constant_curvature/mod.rs"),
    ("MAX_CONTACTS", "crates/simulation/src/manipulator/spatial/mod.rs"),
    ("MAX_CORES", "physics_proc/src/process/disturbance.rs"),
    ("MAX_EVALUATIONS", "crates/simulation/src/rigid/coupling.rs"),
    ("MAX_FILE_BYTES", "crates/volume_io/src/dicom/file.rs"),
    ("MAX_FREEDOMS", "crates/simulation/src/manipulator/moment_modes/mod.rs"),
    ("MAX_FREEDOMS", "crates/simulation/src/manipulator/pressing.rs"),
    ("MOST_FAR_PLANES", "crates/simulation/src/bone/query.rs"),
    ("MOST_PLANES", "crates/simulation/src/bone/yielding.rs"),
    ("MOST_NORMALS", "crates/simulation/src/bone/yielding.rs"),
    ("MAX_GROUPS", "physics_proc/src/process/held_back.rs"),
    ("MAX_HALVINGS", "crates/xray/src/slice_ordered/parts.rs"),
    ("MAX_JOINT_RAD", "crates/ros_interface/src/incoming.rs"),
    ("MAX_JOINT_RATE_RAD_PER_S", "crates/ros_interface/src/incoming.rs"),
    ("MAX_LAYERS", "crates/xray/src/slice_ordered/plan.rs"),
    ("MAX_SPEED_M_PER_S", "crates/simulation/src/world/lost.rs"),
    ("MAX_STRETCH", "crates/simulation/src/world/lost.rs"),
    ("MAX_LINES", "src/commands/plot.rs"),
    ("MAX_LINES", "crates/xray/src/slice_ordered/plan.rs"),
    ("MAX_LINE_EVALUATIONS", "crates/simulation/src/rigid/descent.rs"),
    ("MAX_PANELS", "src/commands/plot.rs"),
    ("MAX_RECORD_BYTES", "crates/run_log/src/records.rs"),
    ("MAX_REMOVED_BYTES", "crates/run_log/src/stream/in_chunk.rs"),
    ("MAX_ROUNDS", "crates/simulation/src/manipulator/step.rs"),
    ("MAX_SPHERES", "crates/simulation/src/manipulator/mod.rs"),
    ("MAX_STEP", "crates/xray/src/slice_ordered/plan.rs"),
    ("MAX_STRAY_PIXELS", "crates/controllers/src/tip_finder.rs"),
    ("MAX_TENDONS", "crates/simulation/src/manipulator/mod.rs"),
    ("MAX_WAITING", "crates/delivery/src/x_ray/schedule.rs"),
    ("MAX_WAITING", "crates/run_log/src/order.rs"),
    ("MOST", "crates/viewer_proc/src/log/marks.rs"),
    ("MOST", "crates/xray/src/slice_ordered/splat.rs"),
    ("MOST_ASKED", "crates/viewer_proc/src/live/subscriptions.rs"),
    ("MOST_COUNTED", "crates/scene/src/cutter.rs"),
    ("MOST_TWIST_DEG", "crates/scene/src/check/tool.rs"),
    ("MOST_CHARACTERS", "crates/foreign_text/src/lib.rs"),
    ("MOST_DAMPING", "crates/identify/src/solver.rs"),
    ("MOST_WIDENING", "crates/identify/src/solver.rs"),
    ("MOST_STEP", "crates/identify/src/solver.rs"),
    ("MOST_POINTS", "src/identify/figure.rs"),
    ("MOST_COMPLAINTS", "crates/bridge_proc/src/igtl/connection.rs"),
    ("MOST_LATE_NS", "crates/viewer_proc/src/log/series/mod.rs"),
    ("MOST_OF_A_LINE", "crates/foreign_text/src/lib.rs"),
    ("MOST_REMOVED", "crates/viewer_proc/src/log/marks.rs"),
    ("MOST_STOPS", "crates/simulation/src/manipulator/contact.rs"),
    ("MOST_ROWS", "crates/viewer_proc/src/log/compare.rs"),
];

fn sources(folder: &Path, found: &mut Vec<String>) {
    for entry in std::fs::read_dir(folder).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path.strip_prefix(root()).unwrap().to_str().unwrap().to_owned());
        }
    }
}

/// Regression: a full pool of partly cut voxels stopped the burr, and no page mentioned the pool.
#[test]
fn the_table_of_capacities_holds_the_values_of_the_code() {
    let page = read("docs/capacities.md");
    let mut listed = Vec::new();
    for row in page.lines().filter(|line| line.contains("` in `")) {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let (most, constant) = (cells[2].split(' ').next().unwrap_or_default(), cells[3].trim_matches('`'));
        let (name, path) = constant.split_once("` in `").unwrap();
        assert_eq!(most.parse(), Ok(value(path, name)), "{row}");
        listed.push((name.to_owned(), path.to_owned()));
    }
    assert!(listed.len() > 60, "{} rows", listed.len());
    let known = |name: &str, path: &str| {
        listed.iter().any(|row| (row.0.as_str(), row.1.as_str()) == (name, path))
            || NO_CAPACITIES.contains(&(name, path))
    };
    let mut files = Vec::new();
    packages().iter().for_each(|(_, folder)| sources(&folder.join("src"), &mut files));
    sources(&root().join("src"), &mut files);
    let ours =
        files.iter().filter(|path| !path.starts_with("fuzz") && !path.starts_with("crates/hub/schedules"));
    for path in ours {
        for (name, _) in constants(path) {
            let capacity = ["MAX_", "MOST", "LONGEST"].iter().any(|start| name.starts_with(start));
            assert!(!capacity || known(&name, path), "docs/capacities.md lacks `{name}` of {path}");
        }
    }
}
