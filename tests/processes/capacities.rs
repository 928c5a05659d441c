//! A capacity that is reached during a run is reported: as an event, in the final table, in `summary.json`.

use ipc_types::messages::EventCode;

use crate::common::logs::{assert_replays, events};
use crate::common::program::Place;

/// 39 spheres (32 links) of 6 mm between four walls and in a hole of the same width: 156 contacts with the
/// walls, and about 300 with the bone. The planar solver has room for 410.
const CROWDED: &str = "
name = \"crowded\"
[run]
mode = \"lockstep\"
duration_s = 0.02
seed = 7

[volume]
phantom = \"block\"
spacing_mm = 0.5

[[predrill]]
from_mm = [0.0, 0.0, -90.0]
to_mm = [0.0, 0.0, 0.0]
diameter_mm = 6.0

[manipulator]
links = 32
burr_diameter_mm = 6.0

[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]

[[controller]]
name = \"holder\"
drives = [\"tendon\", \"arm\", \"burr\"]
hold = { tension_n = 2.0 }
";

/// A wall that touches the tool on one of its sides.
fn wall(side: usize) -> String {
    let position_mm = [[23, 0, 0], [-23, 0, 0], [0, 23, 0], [0, -23, 0]][side];
    format!(
        "[[body]]\nname = \"wall_{side}\"\ncuboid = {{ half_extents_mm = [20.0, 20.0, 500.0] }}\nmotion = \"fixed\"\n\
         position_mm = {position_mm:?}\n"
    )
}

#[test]
fn a_capacity_that_is_reached_is_an_event_a_warning_and_a_count() {
    let place = Place::new();
    let scene = |walls: usize| CROWDED.to_owned() + &(0..walls).map(wall).collect::<String>();
    let ended = place.complete(&scene(4));
    let words = "contacts exert no force";

    let said = events(&ended.folder, EventCode::CapacityReached);
    // Reported immediately, then once per second; this run is shorter.
    assert!(said.len() == 1 && said[0].0 == 0 && said[0].1.contains(words), "{said:?}");

    assert!(said[0].1.starts_with("contact capacity reached: "), "{said:?}");
    // The walls overlap the tool at the start. Pushing it out creates no energy: no later warning says so.
    let last = ended.out.lines().find(|line| line.starts_with("last warning")).unwrap_or_default();
    assert!(last.contains(words), "{}", ended.out);
    let events = ended.out.lines().find(|line| line.starts_with("events")).unwrap_or_default();
    assert!(events.contains("1 capacity_reached"), "{}", ended.out);

    let summary = ended.summary();
    assert_eq!(summary["events"]["capacity_reached"], 1);
    assert!(summary["warnings"].to_string().contains(words), "{summary}");
    assert_replays(&ended.folder);

    // With enough room there is no such event.
    let other = Place::new();
    let ended = other.complete(&scene(1));
    assert!(!ended.out.contains("capacity_reached"), "{}", ended.out);
}
