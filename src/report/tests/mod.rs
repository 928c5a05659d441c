//! Reports of a synthetic run, of truncated logs and of missing logs.

pub(super) mod synthetic;

use std::fs;
use std::path::Path;

use super::*;
use fastrand::Rng;
use ipc_types::messages::{
    ArmProtectiveStop, Command, EVENT_BREACH, EVENT_LOG_SAVED, Latched, Pose, RunStatus, SENDER_CONTROLLER,
    SENDER_PHYSICS, SENDER_RECORDER, SEVERITY_INFO, SEVERITY_WARNING, State, Tick,
};
use recorder_proc::log_file::{create_run, create_timing};
use run_log::{EndReason, LogHeader, RunMode, Topic, command_topic};
use zerocopy::IntoBytes;

const TICKS: u64 = 2000;

fn facts() -> RunFacts {
    RunFacts {
        wall_s: 4.0,
        startup_s: 0.5,
        phases_s: BTreeMap::from([("volume".to_string(), 0.25)]),
        outcome: "completed".to_string(),
        peak_memory_bytes: BTreeMap::from([("physics".to_string(), 40_000_000)]),
        processor_s: BTreeMap::from([("physics".to_string(), 2.5)]),
        // A file's voxels are no cubes, unless the scene asks for them.
        volume_spacing_m: Some([5e-4, 2.5e-4, 1e-3]),
        anatomy: None,
        replay_command: "trabecula replay runs/x/run.mcap".to_string(),
    }
}

fn picture(path: &Path) -> (u32, u32, Vec<u8>) {
    let mut reader =
        png::Decoder::new(std::io::BufReader::new(fs::File::open(path).unwrap())).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    pixels.truncate(info.buffer_size());
    (info.width, info.height, pixels)
}

/// Checks that all figures exist, have the right size, are not blank and show no non-finite numbers.
fn check_figures(folder: &Path) {
    for (stem, size) in [("tip_path", (1760, 1440)), ("timing", (1760, 1400))] {
        let (width, height, pixels) = picture(&folder.join(format!("{stem}.png")));
        assert_eq!((width, height), size);
        let dark = pixels.chunks_exact(3).filter(|rgb| rgb.iter().all(|&c| c < 100)).count();
        assert!(dark > 2000, "{stem}: {dark} dark pixels: axes and labels are missing");
        let svg = fs::read_to_string(folder.join(format!("{stem}.svg"))).unwrap();
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
        assert!(svg.contains(&format!("width=\"{}\" height=\"{}\"", size.0 / 2, size.1 / 2)));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{stem}");
    }
}

/// Writes a report and requires it to be complete.
fn write(folder: &Path, facts: &RunFacts) -> Result<Summary, ReportError> {
    let report = super::write(folder, facts)?;
    assert!(report.missing.is_empty(), "{:?}", report.missing);
    Ok(report.summary)
}

#[test]
fn a_run_is_summed_up() {
    let folder = tempfile::tempdir().unwrap();
    synthetic::write_run(folder.path(), TICKS);
    let summary = write(folder.path(), &facts()).unwrap();
    check_figures(folder.path());
    let timing = TimingLane::read(&folder.path().join("timing.mcap")).unwrap();
    let run = RunLane::read(&folder.path().join("run.mcap"), Some(timing.end_ns), None);
    assert_eq!(tip_figure::draw(&run).unwrap().collisions(), []);
    assert_eq!(timing_figure::draw(&timing, run.end_ns).unwrap().collisions(), []);

    let last = synthetic::state(TICKS, TICKS, &mut Rng::with_seed(1));
    let (tool, drilling) = (summary.tool.as_ref().unwrap(), summary.drilling.as_ref().unwrap());
    assert_eq!((summary.ticks, summary.simulated_s, summary.real_time_factor), (TICKS, 2.0, Some(0.5)));
    assert_eq!(summary.final_hash.as_deref(), Some(format!("{:016x}{TICKS:016x}", !TICKS).as_str()));
    assert_eq!(tool.tip_end_mm, last.t_world_tip.position_m.map(|x| x * 1e3));
    assert!((tool.bend_deg - 0.8f64.to_degrees()).abs() < 1e-12);
    assert_eq!(tool.max_tension_n, 12.0);
    let [x, _, z] = last.t_world_burr.position_m;
    let error_mm = ((x * 1e3 - 12.0).powi(2) + (z * 1e3 - 27.0).powi(2)).sqrt();
    assert!((tool.target_error_mm.unwrap() - error_mm).abs() < 1e-9);
    assert_eq!((drilling.removed_voxels, drilling.removed_volume_mm3), (4000, Some(500.0)));
    assert_eq!((drilling.cutting_energy_j, drilling.max_contacts), (25.0, 3));
    assert!(drilling.max_burr_force_n > 4.5 && drilling.max_burr_force_n < 5.0);
    assert_eq!(drilling.max_contact_force_n, 2.0 * drilling.max_burr_force_n);
    // Ticks 201 to 1799 drill.
    assert_eq!(drilling.contact_share, 1599.0 / 2000.0);

    let drr = summary.drr.as_ref().unwrap();
    assert_eq!((drr.frames, drr.full_frames, drr.rays_per_frame), (20, 1, Some(1000.0)));
    assert_eq!((drr.frames_per_simulated_s, drr.frames_per_wall_s), (Some(10.0), Some(5.0)));
    // Three digits: 0.1 %.
    assert!((drr.render_ms.unwrap().p50 - 5.0).abs() < 5e-3);

    let timing = &summary.timing;
    assert_eq!(timing.missed_ticks, 2);
    assert!((timing.lateness_us.unwrap().max - 2300.0).abs() < 2.3);
    let trips = &timing.round_trip_us;
    assert_eq!(trips.keys().collect::<Vec<_>>(), ["guide", "watch"]);
    assert!(trips["guide"].p50 > 60.0 && trips["guide"].max <= 120.12 && trips["watch"].max <= 45.05);
    let step = timing.step_us.unwrap();
    assert!(step.count == TICKS && step.p50 > 30.0 && step.p50 < 60.0 && step.max > 240.0);

    assert_eq!((summary.events["command_held"], summary.events["run"]), (8, 1));
    assert_eq!(summary.warnings.len(), 5);
    assert_eq!(summary.warnings[4], "tick 7, watch: late by 7 ticks again");
    assert_eq!(summary.logs.lost_messages["/event"], 3);
    assert!(summary.logs.notes.is_empty() && summary.logs.run_bytes > 0 && summary.logs.timing_bytes > 0);

    let json = fs::read_to_string(folder.path().join("summary.json")).unwrap();
    assert_eq!(json, serde_json::to_string_pretty(&summary).unwrap() + "\n", "the file says the same");
    assert_eq!(serde_json::from_str::<Summary>(&json).unwrap().final_hash, summary.final_hash);
    let table = summary.to_string();
    assert!(table.lines().count() <= 23, "{table}");
    assert!(table.contains("2.000 s simulated in 4.000 s, 0.50 x real time"), "{table}");
}

/// Returns the cautions of a synthetic run with these states and commands.
fn cautions_of(change: impl Fn(&mut State)) -> Vec<String> {
    let folder = tempfile::tempdir().unwrap();
    synthetic::write_states(folder.path(), 100, change);
    let summary = write(folder.path(), &facts()).unwrap();
    let table = summary.to_string();
    let rows = |caution: &String| table.contains(&format!("caution      {caution}\n"));
    assert!(summary.cautions.iter().all(rows), "{table}");
    // The scene's model bends in one plane, which is reported for every run.
    let (model, others) = summary.cautions.split_last().unwrap();
    assert!(model.starts_with("`planar` bends in one plane: up to "), "{model}");
    others.to_vec()
}

#[test]
fn a_run_with_nothing_wrong_has_only_the_caution_of_its_model() {
    assert_eq!(cautions_of(|_| {}), Vec::<String>::new());
}

#[test]
fn what_is_most_likely_wrong_with_a_run_is_said() {
    let pressed = cautions_of(|state| {
        if state.tick == 40 {
            state.burr_force_n = 60.0;
        }
    });
    assert_eq!(pressed.len(), 1, "{pressed:?}");
    assert!(
        pressed[0].starts_with("burr force reached 60.0 N at tick 40, (")
            && pressed[0].ends_with(") mm, above the arm's payload: 49.1 N"),
        "{pressed:?}"
    );
    let jammed = cautions_of(|state| {
        if state.tick == 40 {
            state.contacts[0].normal_force_n = 1000.0;
            state.contact_count = 1;
        }
    });
    assert_eq!(
        jammed,
        ["contact force reached 1000.0 N at tick 40, (0.0, 0.0, 0.0) mm, above the arm's payload: 49.1 N"]
    );
    let still = cautions_of(|state| state.t_world_tip = Pose::IDENTITY);
    assert_eq!(still, ["the tip never moved more than 0.0000 mm from its start"]);
    let idle = cautions_of(|state| {
        state.burr_speed_rad_per_s = 0.0;
        if state.tick == 40 {
            state.burr_force_n = 6.0;
        }
    });
    assert_eq!(idle.len(), 1, "{idle:?}");
    assert!(
        idle[0].starts_with("the burr pressed on bone without turning, with up to 6.0 N at tick 40, ("),
        "{idle:?}"
    );
    let stopped = cautions_of(|state| state.arm_protective_stop = u32::from((40..60).contains(&state.tick)));
    assert_eq!(stopped, ["the arm made a protective stop at tick 40"]);
    let short =
        cautions_of(|state| state.t_world_base.position_m[2] = state.t_world_base.position_m[2].min(-0.12));
    assert!(
        short.len() == 1 && short[0].starts_with("the tool was fed 18.1 mm of the 32.0 mm planned"),
        "{short:?}"
    );
    let stopped = cautions_of(|state| {
        if state.tick > 75 {
            state.joint_position_rad[3] = -0.0873;
        }
    });
    assert_eq!(stopped, ["the tool was at its stops in 25.0 % of the ticks and could not bend further"]);
}

/// The events of a breach by the physics, and of one that a controller made up.
#[test]
fn a_breach_that_the_physics_reported_is_a_caution() {
    let folder = tempfile::tempdir().unwrap();
    synthetic::write_run(folder.path(), 100);
    let timing = folder.path().join("timing.mcap");
    fs::remove_file(&timing).unwrap();
    let mut lane = create_timing(&timing, &synthetic::header()).unwrap();
    for (tick, sender) in [(40, SENDER_PHYSICS), (50, SENDER_CONTROLLER)] {
        let event =
            synthetic::event(tick, SEVERITY_WARNING, EVENT_BREACH, sender, "the burr breached the bone");
        lane.message(Topic::Event, Tick(100), &event).unwrap();
    }
    lane.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    let summary = write(folder.path(), &facts()).unwrap();
    assert_eq!(summary.cautions[0], "tick 40: the burr breached the bone");
    assert_eq!((summary.breaches, summary.problems()), (1, 1));
}

#[test]
fn the_share_of_refused_commands_is_said() {
    let folder = tempfile::tempdir().unwrap();
    synthetic::write_run(folder.path(), 100);
    let timing = folder.path().join("timing.mcap");
    fs::remove_file(&timing).unwrap();
    let mut lane = create_timing(&timing, &synthetic::header()).unwrap();
    for sequence in 1..=40 {
        let sent = Command { sequence, ..Command::zeroed() };
        lane.command(&command_topic("guide"), Tick(sequence), sent.as_bytes()).unwrap();
    }
    let status = RunStatus { refused_commands: 10, ..RunStatus::zeroed() };
    lane.message(Topic::RunStatus, Tick(40), status.as_bytes()).unwrap();
    lane.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    let summary = write(folder.path(), &facts()).unwrap();
    assert_eq!(summary.cautions[0], "10 of 40 commands rejected (25.0 %)");
}

/// Regression: with `recording.ring_s` the tolerance was silently not checked, the counters of the whole run
/// were those of the kept ticks ("4529 of 990 commands rejected"), and a stop before them was a stop in them.
#[test]
fn a_log_that_begins_late_is_reported_as_what_it_is() {
    let header = LogHeader { first_tick: Tick(100), ..synthetic::header() };
    let folder = tempfile::tempdir().unwrap();
    let mut run = create_run(&folder.path().join("run.mcap"), &header).unwrap();
    let mut lane = create_timing(&folder.path().join("timing.mcap"), &header).unwrap();
    let stopped = |tick: u64| {
        let mut state = synthetic::state(tick, 200, &mut Rng::with_seed(1));
        state.arm_protective_stop = ArmProtectiveStop::Stopped.code();
        state
    };
    run.state(&stopped(100)).unwrap();
    for tick in 100..200 {
        run.latched(&Latched { tick, ..Latched::zeroed() }).unwrap();
        run.state(&stopped(tick + 1)).unwrap();
        let sent = Command { sequence: tick, ..Command::zeroed() };
        lane.command(&command_topic("guide"), Tick(tick), sent.as_bytes()).unwrap();
        let counted = 4000 + tick / 10;
        let status = RunStatus { refused_commands: counted, missed_ticks: counted, ..RunStatus::zeroed() };
        lane.message(Topic::RunStatus, Tick(tick), status.as_bytes()).unwrap();
    }
    for text in ["saved-1: ticks 0 to 90 or later: breach", "saved-2: ticks 100 to 300 or later: breach"] {
        let event = synthetic::event(200, SEVERITY_INFO, EVENT_LOG_SAVED, SENDER_RECORDER, text);
        lane.message(Topic::Event, Tick(200), &event).unwrap();
    }
    fs::create_dir(folder.path().join("saved-1")).unwrap();
    run.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    lane.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    let mut summary = write(folder.path(), &facts()).unwrap();
    assert_eq!(summary.logs.saved, ["saved-1", "saved-2 as run.mcap"]);
    assert!(summary.to_string().contains("\nsaved        saved-1, saved-2 as run.mcap\n"), "{summary}");
    summary.logs.saved = (1..=45).map(|number| format!("saved-{number}")).collect();
    assert!(summary.to_string().contains("\nsaved        45 logs, saved-1 to saved-45\n"), "{summary}");
    let cautions: Vec<&str> = summary.cautions.iter().map(String::as_str).collect();
    let unchecked = "`tolerance.target_mm` and `tolerance.path_deviation_mm` not checked: \
                     the start of the run was not kept";
    assert_eq!(cautions[..2], ["9 of 100 commands rejected (9.0 %)", unchecked]);
    assert_eq!((summary.outcome.as_str(), summary.timing.missed_ticks), ("completed", 9));
    assert_eq!(summary.plan.unwrap().protective_stops, 0);
}

#[test]
fn the_middle_frame_is_the_one_nearest_the_middle() {
    let folder = tempfile::tempdir().unwrap();
    synthetic::write_run(folder.path(), TICKS);
    write(folder.path(), &facts()).unwrap();
    // Frame n lies at tick 1 + 100 (n - 1); frame 11 is nearest to the middle of 2000 ticks. A frame's first
    // pixel is its number.
    for (name, number) in [("before", 1), ("half", 11), ("after", 20)] {
        let (columns, rows, pixels) = picture(&folder.path().join(format!("drr_{name}.png")));
        assert_eq!((columns, rows, pixels[0]), (64, 48, number));
    }
}

#[test]
fn a_cut_log_gives_what_it_holds() {
    let whole = tempfile::tempdir().unwrap();
    synthetic::write_run(whole.path(), 600);
    let bytes = ["run.mcap", "timing.mcap"].map(|name| fs::read(whole.path().join(name)).unwrap());
    let mut ticks = Vec::new();
    for share in [0.0, 0.02, 0.5, 0.9] {
        let folder = tempfile::tempdir().unwrap();
        for (name, bytes) in ["run.mcap", "timing.mcap"].iter().zip(&bytes) {
            fs::write(folder.path().join(name), &bytes[..(bytes.len() as f64 * share) as usize]).unwrap();
        }
        let summary = write(folder.path(), &facts()).unwrap();
        assert_eq!(summary.logs.notes.len(), 2, "{:?}", summary.logs.notes);
        assert!(summary.to_string().lines().count() <= 23);
        check_figures(folder.path());
        ticks.push(summary.ticks);
    }
    assert!(ticks[0] == 0 && ticks[2] > 0 && ticks[3] > ticks[2] && ticks[3] < 600, "{ticks:?}");
}

#[test]
fn a_run_without_ticks_or_logs_is_reported() {
    let folder = tempfile::tempdir().unwrap();
    let summary = write(folder.path(), &facts()).unwrap();
    assert_eq!((summary.ticks, summary.scene, summary.logs.notes.len()), (0, None, 2));
    check_figures(folder.path());

    let folder = tempfile::tempdir().unwrap();
    let header = LogHeader { mode: RunMode::Lockstep, ..synthetic::header() };
    let mut run = create_run(&folder.path().join("run.mcap"), &header).unwrap();
    run.state(&synthetic::state(0, 1, &mut Rng::with_seed(1))).unwrap();
    run.finish(EndReason::Interrupted, &BTreeMap::new()).unwrap();
    let timing = create_timing(&folder.path().join("timing.mcap"), &header).unwrap();
    timing.finish(EndReason::Interrupted, &BTreeMap::new()).unwrap();
    let summary = write(folder.path(), &facts()).unwrap();
    assert_eq!((summary.ticks, summary.scene.as_deref()), (0, Some("synthetic")));
    assert_eq!((summary.mode.as_deref(), summary.tool.is_some()), (Some("lockstep"), true));
    assert!(summary.drr.is_none() && summary.timing.step_us.is_none() && summary.logs.notes.is_empty());
    let tip_mm = summary.tool.unwrap().tip_end_mm;
    assert!(tip_mm[2].abs() < 1e-9);
    check_figures(folder.path());
    assert!(!folder.path().join("drr_before.png").exists());
}

#[test]
fn numbers_that_are_none_do_not_stop_the_drawing() {
    let folder = tempfile::tempdir().unwrap();
    let mut run = create_run(&folder.path().join("run.mcap"), &synthetic::header()).unwrap();
    for tick in 0..50 {
        let mut state = synthetic::state(tick, 50, &mut Rng::with_seed(1));
        if tick > 20 {
            state.bend_rad = f64::NAN;
            state.burr_force_n = if tick % 2 == 0 { f64::INFINITY } else { 1e200 };
            state.tendon_tension_n[0] = if tick % 2 == 0 { f64::MAX } else { -f64::MAX };
            state.t_world_tip.position_m = [f64::NAN; 3];
            state.t_world_link[3].position_m = [f64::NEG_INFINITY; 3];
        }
        if tick > 0 {
            let mut latched = ipc_types::messages::Latched::zeroed();
            latched.tick = tick - 1;
            run.latched(&latched).unwrap();
        }
        run.state(&state).unwrap();
    }
    run.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    let summary = write(folder.path(), &facts()).unwrap();
    assert_eq!(summary.ticks, 49);
    check_figures(folder.path());
}

#[test]
fn a_folder_that_is_not_there_costs_the_files_and_no_number() {
    let folder = tempfile::tempdir().unwrap();
    let report = super::write(&folder.path().join("missing"), &facts()).unwrap();
    assert_eq!((report.summary.ticks, report.missing.len()), (0, 6));
    let named = |error: &FigureError| {
        matches!(error, FigureError::Output(_)) && error.to_string().contains("missing")
    };
    assert!(report.missing.iter().all(named), "{:?}", report.missing);
}

/// Regression: one unwritable image lost the table and the summary, and a report overwrote an existing file.
#[test]
fn a_picture_that_cannot_be_written_costs_nothing_else_and_replaces_nothing() {
    let folder = tempfile::tempdir().unwrap();
    synthetic::write_run(folder.path(), 500);
    let names = ["drr_before.png", "tip_path.svg", "timing.png"];
    fs::create_dir(folder.path().join(names[0])).unwrap();
    names[1..].iter().for_each(|name| fs::write(folder.path().join(name), "a user's own").unwrap());
    let report = super::write(folder.path(), &facts()).unwrap();
    let missing: Vec<String> = report.missing.iter().map(ToString::to_string).collect();
    assert_eq!(missing.len(), 3, "{missing:?}");
    assert!(
        missing.iter().zip(names).all(|(text, name)| text.contains(&format!("{name}: already exists"))),
        "{missing:?}"
    );
    assert!(folder.path().join(names[0]).is_dir());
    for name in &names[1..] {
        assert_eq!(fs::read_to_string(folder.path().join(name)).unwrap(), "a user's own");
    }
    for name in ["summary.json", "drr_half.png", "drr_after.png", "tip_path.png", "timing.svg"] {
        assert!(folder.path().join(name).is_file(), "{name}");
    }
    assert_eq!(report.summary.ticks, 500);
}

/// Any text of the page can be untrusted, such as a scene's or a controller's.
#[test]
fn the_page_holds_all_pictures_and_no_text_of_a_stranger_becomes_a_part_of_it() {
    let folder = tempfile::tempdir().unwrap();
    synthetic::write_run(folder.path(), TICKS);
    let evil = "</pre><script src=\"http://example.org/x.js\"></script>";
    let facts = RunFacts { outcome: evil.to_owned(), replay_command: evil.to_owned(), ..facts() };
    write(folder.path(), &facts).unwrap();
    let page = fs::read_to_string(folder.path().join("report.html")).unwrap();
    assert!(
        !page.contains("<script") && (page.contains("&#60;script") || page.contains("&lt;script")),
        "{page:.400}"
    );
    // Everything that the browser loads is embedded in the page.
    let sources: Vec<&str> =
        page.split("src=\"").skip(1).map(|rest| rest.split('"').next().unwrap()).collect();
    assert_eq!(sources.len(), 5);
    assert!(sources.iter().all(|source| source.starts_with("data:image/")));
    for (source, file) in
        sources.iter().zip(["drr_before.png", "drr_half.png", "drr_after.png", "tip_path.svg", "timing.svg"])
    {
        let bytes = data_encoding::BASE64.decode(source.split_once(',').unwrap().1.as_bytes()).unwrap();
        assert!(bytes == fs::read(folder.path().join(file)).unwrap(), "{file}");
    }
    let summary = fs::read_to_string(folder.path().join("summary.json")).unwrap();
    let summary: Summary = serde_json::from_str(&summary).unwrap();
    let first = summary.to_string().lines().next().unwrap().split(',').next().unwrap().to_owned();
    assert!(page.contains(&first) && page.contains("duration_s"), "{first}");
    assert!(!page.contains("href=") && page.contains("default-src 'none'"));
}
