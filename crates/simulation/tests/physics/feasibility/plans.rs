//! Tasks of the controllers, the arm and the X-ray within the duration of the run.

use crate::feasibility::scene_text::{Case, HOLE, case, changed, changed_in, driven_by, target};

pub fn cases() -> Vec<Case> {
    [arm(), targets(), times(), programs(), several_at_once()].into_iter().flatten().collect()
}

fn arm() -> Vec<Case> {
    let joints = |degrees: &str| format!("[arm]\ninitial_joints_deg = [{degrees}]\n");
    let singular = joints("0.0, -90.0, 0.0, -90.0, -90.0, 0.0");
    vec![
        case(
            "a singular start",
            changed("[arm]\n", &singular),
            &["impossible: `arm.initial_joints_deg` is singular (manipulability 0.0e0 m³; allowed: \
               1e-4 or more): the arm cannot insert from there"],
        ),
        case(
            "a start just singular",
            changed("[arm]\n", &joints("0.0, -90.0, 90.0, -90.0, 0.069, 0.0")),
            &["impossible: `arm.initial_joints_deg` is singular (manipulability 9.8e-5 m³; allowed: \
               1e-4 or more): the arm cannot insert from there"],
        ),
        case(
            "a start just short of singular",
            changed("[arm]\n", &joints("0.0, -90.0, 90.0, -90.0, 0.072, 0.0")),
            &[],
        ),
        case(
            "a singular start, driven by a program",
            changed_in(&driven_by("external = true"), "[arm]\n", &singular),
            &["unlikely: `arm.initial_joints_deg` is singular (manipulability 0.0e0 m³, Cartesian \
               motion needs 1e-4): only joint commands work from there"],
        ),
        case(
            "a singular start, and the arm is held",
            changed_in(&driven_by("hold = { tension_n = 1.0 }"), "[arm]\n", &singular),
            &[],
        ),
        case(
            "a gantry whose travel ends before the feed",
            changed("[arm]\n", "[arm]\nmodel = \"gantry\"\ntravel_mm = [20.0, 20.0, 5.0]\n"),
            &["impossible: `arm.model` cannot follow the feed \
               (`controller.curved_drilling.insertion_mm` = 20): at 0.28125 of the path: gantry axis z \
               out of range: 0.005625 m, its travel is -0.005 to 0.005 m from the start; move the \
               goal, or increase `arm.travel_mm`"],
        ),
        case(
            "a gantry whose travel is just as long as the feed",
            changed("[arm]\n", "[arm]\nmodel = \"gantry\"\ntravel_mm = [20.0, 20.0, 20.1]\n"),
            &[],
        ),
        case(
            "a wrist whose range ends on the way",
            changed(
                "[arm]\n",
                "[arm]\nlower_joints_deg = [-360.0, -360.0, -180.0, -128.0, -360.0, -360.0]\n\
                 upper_joints_deg = [360.0, 360.0, 180.0, -126.0, 360.0, 360.0]\n\
                 initial_joints_deg = [0.0, -69.0, 103.0, -127.0, -90.0, 0.0]\n",
            ),
            &["impossible: `arm.model` cannot follow the feed \
               (`controller.curved_drilling.insertion_mm` = 20): at 0.375 of the path: all 8 solutions \
               for the pose violate the joint limits; move the goal or the arm base"],
        ),
        case(
            "no arm, but a controller that feeds with it",
            changed("[arm]\n", "[arm]\nmodel = \"fixed\"\n"),
            &["impossible: `arm.model` is \"fixed\", but a controller drives the arm; choose an arm, \
               or remove \"arm\" from `controller.drives`"],
        ),
        case(
            "no arm, and no controller drives it",
            changed_in(&driven_by("external = true"), "[arm]\n", "[arm]\nmodel = \"fixed\"\n")
                .replace("\"arm\", ", ""),
            &[],
        ),
        case(
            "a singular start, and no controller drives the arm",
            changed_in(&driven_by("external = true"), "[arm]\n", &singular).replace("\"arm\", ", ""),
            &[],
        ),
    ]
}

fn targets() -> Vec<Case> {
    let long = |place: &str| {
        let text = changed_in(&target(Some(place)), "insertion_mm = 20.0", "insertion_mm = 60.0");
        changed_in(&text, "duration_s = 4.0", "duration_s = 8.0")
    };
    vec![
        case(
            "a target behind the start",
            target(Some("[100.0, 0.0, -20.0]")),
            &["impossible: `controller.curved_drilling.target_mm` is 5.0 mm behind the start; allowed: \
               0 to 20 mm ahead (`insertion_mm`)"],
        ),
        case("a target at the start", target(Some("[100.0, 0.0, -15.0]")), &[]),
        case("a target behind the start by less than is printed", target(Some("[100.0, 0.0, -15.04]")), &[]),
        case(
            "a target behind the start by what is printed",
            target(Some("[100.0, 0.0, -15.06]")),
            &["impossible: `controller.curved_drilling.target_mm` is 0.1 mm behind the start; allowed: \
               0 to 20 mm ahead (`insertion_mm`)"],
        ),
        case(
            "a target 308 mm away",
            target(Some("[100.0, 0.0, 293.0]")),
            &["impossible: `controller.curved_drilling.target_mm` is 308.0 mm ahead of the start; \
               allowed: 0 to 20 mm (`insertion_mm`)"],
        ),
        case("a target ahead by the insertion and the bound", target(Some("[100.0, 0.0, 5.5]")), &[]),
        case(
            "a target just farther ahead",
            target(Some("[100.0, 0.0, 5.6]")),
            &["impossible: `controller.curved_drilling.target_mm` is 20.6 mm ahead of the start; \
               allowed: 0 to 20 mm (`insertion_mm`)"],
        ),
        case("a target beside by the tool's flexible length", long("[135.3, 0.0, 20.0]"), &[]),
        case(
            "a target just farther beside",
            long("[135.5, 0.0, 20.0]"),
            &["impossible: `controller.curved_drilling.target_mm` is 35.5 mm off the feed axis; \
               allowed: 0 to 35.4 (the tool's flexible length)"],
        ),
    ]
}

fn times() -> Vec<Case> {
    let rate = |hz: &str| changed("rate_hz = 5.0", &format!("rate_hz = {hz}"));
    let step = |dt_ms: &str| {
        changed("duration_s = 4.0", &format!("duration_s = 4.0\ndt_ms = {dt_ms}"))
            .replace("rate_hz = 5.0", "rate_hz = 4.0")
    };
    let skiving = |duration: &str| {
        let skiving = "skiving = { feed_mm_per_s = 8.0, depth_mm = 20.0, burr_speed_rpm = 8000.0 }";
        changed_in(&driven_by(skiving), "duration_s = 4.0", duration)
    };
    vec![
        case(
            "an insertion of 133 s in a run of 24",
            changed("duration_s = 4.0", "duration_s = 24.0")
                .replace("feed_mm_per_s = 8.0", "feed_mm_per_s = 0.15"),
            &["unlikely: `run.duration_s` is 24, but `controller.curved_drilling` needs 133.3 s"],
        ),
        case("an insertion that takes the whole run", changed("duration_s = 4.0", "duration_s = 2.5"), &[]),
        case(
            "an insertion that takes a tick longer than the run",
            changed("duration_s = 4.0", "duration_s = 2.499"),
            &["unlikely: `run.duration_s` is 2.499, but `controller.curved_drilling` needs 2.5 s"],
        ),
        case(
            "an insertion that fits, a retraction that does not",
            changed(
                "insertion_mm = 20.0",
                "insertion_mm = 20.0\nretraction_mm = 20.0\nretraction_mm_per_s = 10.0",
            ),
            &["unlikely: `run.duration_s` is 4, but `controller.curved_drilling` needs 4.5 s"],
        ),
        case(
            "a straight feed that takes longer than the run",
            skiving("duration_s = 2.0"),
            &["unlikely: `run.duration_s` is 2, but `controller.skiving` needs 2.5 s"],
        ),
        case(
            "a sweep that takes longer than the run",
            driven_by("tension_sweep = { most_n = 5.0, step_n = 1.0 }"),
            &["unlikely: `run.duration_s` is 4, but `controller.tension_sweep` needs 5.5 s"],
        ),
        case(
            "a frame rate that is rounded",
            rate("7.0"),
            &["unlikely: `drr.rate_hz` is 7, but a frame every 143 ticks of 1 ms is 6.993 Hz"],
        ),
        case("a frame rate of whole ticks", rate("8.0"), &[]),
        case("a frame rate of whole ticks, written with four digits", rate("33.33"), &[]),
        case("a frame rate that is hardly rounded", rate("8.0015"), &[]),
        case(
            "a frame rate that is rounded a little more",
            rate("8.0017"),
            &["unlikely: `drr.rate_hz` is 8.0017, but a frame every 125 ticks of 1 ms is 8.000 Hz"],
        ),
        case("frames on request only", rate("0.0"), &[]),
        case("the largest frame rate that a scene may have", rate("200.0"), &[]),
        case(
            "a frame rate above what the ticks allow",
            changed_in(&rate("60.0"), "duration_s = 4.0", "duration_s = 4.0\ndt_ms = 10.0"),
            &[
                "unlikely: `run.dt_ms` is 10; expected at most 2 in bone: longer steps change the \
                 drilled path and make forces jump",
                "unlikely: `drr.rate_hz` is 60, but a frame every 2 ticks of 10 ms is 50.000 Hz",
            ],
        ),
        case("the longest step in bone", step("2.0"), &[]),
        case(
            "a step in bone that is longer",
            step("2.5"),
            &["unlikely: `run.dt_ms` is 2.5; expected at most 2 in bone: longer steps change the \
               drilled path and make forces jump"],
        ),
    ]
}

fn programs() -> Vec<Case> {
    let second = "external = true\n[[controller]]\nname = \"c_arm\"\ndrives = [\"c_arm\"]\n\
                  command = [\"/no/such/program\"]";
    vec![
        case(
            "a program that does not exist",
            driven_by("command = [\"pyhton3\", \"pilot.py\"]"),
            &["impossible: `controller.command` of `reference`: program `pyhton3` not found; expected \
               a path to an executable file or a name in PATH"],
        ),
        case(
            "the second controller's program does not exist",
            driven_by(second),
            &["impossible: `controller.command` of `c_arm`: program `/no/such/program` not found; \
               expected a path to an executable file or a name in PATH"],
        ),
    ]
}

fn several_at_once() -> Vec<Case> {
    let wrong = changed(HOLE, "")
        .replace("duration_s = 4.0", "duration_s = 1.0")
        .replace("rate_hz = 5.0", "rate_hz = 7.0");
    vec![
        case(
            "four unlikely findings at once",
            wrong,
            &[
                "unlikely: `tool.burr_start_mm` puts the burr 12.0 mm inside bone; start in front of \
                 it, or in a `[[predrill]]` hole",
                "unlikely: `tool.burr_start_mm` puts the shaft up to 8.6 mm inside bone; add a \
                 `[[predrill]]` hole along it",
                "unlikely: `run.duration_s` is 1, but `controller.curved_drilling` needs 2.5 s",
                "unlikely: `drr.rate_hz` is 7, but a frame every 143 ticks of 1 ms is 6.993 Hz",
            ],
        ),
        case(
            "all of them at once",
            changed("diameter_mm = 7.0", "diameter_mm = 5.0")
                .replace("rate_hz = 5.0", "rate_hz = 7.0")
                .replace("[manipulator]\n", "[manipulator]\nburr_diameter_mm = 5.5\n")
                .replace("position_mm = [130.0, 0.0, -60.0]", "position_mm = [104.0, 0.0, -60.0]")
                .replace("[arm]\n", "[arm]\ninitial_joints_deg = [0.0, -90.0, 0.0, -90.0, -90.0, 0.0]\n")
                .replace("target_mm = [103.0, 0.0, 4.0]", "target_mm = [100.0, 0.0, -20.0]")
                .replace("duration_s = 4.0", "duration_s = 1.0"),
            &[
                "impossible: `predrill.diameter_mm` is 5; allowed: 6 to 50: the tool, 6.0 mm thick, \
                 starts in this hole",
                "unlikely: `manipulator.burr_diameter_mm` is 5.5: the shaft, 6.0 mm thick, cannot \
                 follow a burr this thin",
                "impossible: `body.position_mm` puts `clamp` 1.00 mm into the tool; allowed: at most 0.1",
                "impossible: `arm.initial_joints_deg` is singular (manipulability 0.0e0 m³; allowed: \
                 1e-4 or more): the arm cannot insert from there",
                "impossible: `controller.curved_drilling.target_mm` is 5.0 mm behind the start; \
                 allowed: 0 to 20 mm ahead (`insertion_mm`)",
                "unlikely: `run.duration_s` is 1, but `controller.curved_drilling` needs 2.5 s",
                "unlikely: `drr.rate_hz` is 7, but a frame every 143 ticks of 1 ms is 6.993 Hz",
            ],
        ),
    ]
}
