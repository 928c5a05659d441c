//! A model that becomes invalid during a run is reported once: as an event, in the final table, in
//! `summary.json`.

use ipc_types::messages::EventCode;

use crate::common::logs::{assert_replays, events, read};
use crate::common::program::Place;

/// The standard tool with the moment modes, held at a tension. Its softest flexure reaches its stop at 10.7
/// N.
fn held(tension_n: f64) -> String {
    format!(
        "name = \"held\"\n[run]\nmode = \"lockstep\"\nduration_s = 0.4\nseed = 7\n[manipulator]\nmodel = \"modal\"\n\
         [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
         [[controller]]\nname = \"holder\"\ndrives = [\"tendon\"]\nhold = {{ tension_n = {tension_n:?} }}\n"
    )
}

#[test]
fn modes_on_stops_are_one_event_a_warning_and_a_count() {
    let place = Place::new();
    let ended = place.complete(&held(12.0));
    let past = |state: &ipc_types::messages::State| state.stop_excess_rad > 0.0;
    let log = read(&ended.folder);
    let all: Vec<_> = log.ticks.iter().map(|record| record.state).filter(past).collect();
    assert!(all.len() > 50, "{} ticks past a stop", all.len());

    let said = events(&ended.folder, EventCode::ModelNotValid);
    let [(tick, text)] = &said[..] else { panic!("{said:?}") };
    let first = &all[0];
    assert_eq!(*tick, first.tick);
    let bends = first.joint_position_rad.iter().map(|q| q.abs()).enumerate();
    let (farthest, _) = bends.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
    let which = format!(
        "flexure {} from the base is {:.3} degrees past it",
        farthest + 1,
        first.stop_excess_rad.to_degrees()
    );
    assert!(text.contains("the model modal is not valid") && text.contains(&which), "{text}, {which}");

    let last = ended.out.lines().find(|line| line.starts_with("last warning")).unwrap_or_default();
    assert!(last.contains(&format!("tick {tick}, physics: the model modal is not valid")), "{}", ended.out);
    assert_eq!(ended.summary()["events"]["model_not_valid"], 1);
    assert_replays(&ended.folder);

    // Within its stops it is valid.
    let other = Place::new();
    let ended = other.complete(&held(6.0));
    assert!(!ended.out.contains("model_not_valid"), "{}", ended.out);
    assert_eq!(events(&ended.folder, EventCode::ModelNotValid), []);
}
