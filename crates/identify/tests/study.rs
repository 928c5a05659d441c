//! Studies as files.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use std::path::Path;

use identify::study::{Commands, Role, Study, Target};

const STUDY: &str = r#"
[[parameter]]
key = "manipulator.stiffness_scale"
min = 0.5
max = 2.0
scale = "log"

[[parameter]]
key = "measured.tip.delay_ms"
min = 0.0
max = 50.0

[[experiment]]
name = "sweep"
scene = "sweep.toml"
file = "sweep.csv"
time = "t"
time_unit = "ms"

[experiment.commands]
column = [{ name = "pull", field = "tendon_force_n[0]", column = "force", unit = "mN", delay_ms = 4.0 }]

[[experiment.measured]]
name = "tip"
of = "position"
frame = "start"
columns = ["x", "", "z"]
unit = "mm"
noise = 0.1
"#;

fn parsed(text: &str) -> Result<Study, String> {
    Study::parse(text, Path::new("study.toml")).map_err(|error| error.to_string())
}

#[test]
fn a_study_is_read_with_its_units_modes_and_targets() {
    let study = parsed(STUDY).unwrap();
    let experiment = &study.experiments[0];
    let measured = &experiment.measured[0];
    assert_eq!(
        (experiment.role, measured.unit, measured.noise.as_deref()),
        (Role::Fitted, 1e-3, Some(&[0.1; 3][..]))
    );
    let Commands::Table(table) = &experiment.commands else { unreachable!("the study has a table") };
    assert_eq!((table.modes, table.columns[0].unit), ([1, 0, 0, 0], 1e-3));
    assert!(matches!(&study.targets[1], Target::Measured { name, .. } if name == "tip"));
    assert_eq!(study.settings(&[1.25, 3.0]), ["manipulator.stiffness_scale=1.25"]);
    let (offset_s, signal) = study.signal(0, measured, &[1.25, 3.0]);
    assert_eq!((offset_s, signal.delay_s), (0.0, 0.003));
    assert_eq!(study.command(&table.columns[0], &[1.25, 3.0]), (1.0, 0.0, 0.004));
    let free = parsed(&STUDY.replace("measured.tip.delay_ms", "command.pull.delay_ms")).unwrap();
    assert_eq!(free.command(&table.columns[0], &[1.25, 3.0]), (1.0, 0.0, 0.003));
}

#[test]
fn bad_studies_are_refused_by_key_with_what_is_allowed() {
    for (from, to, said) in [
        (
            "unit = \"mm\"",
            "unit = \"N\"",
            "`experiment.0.measured.0.unit` is `N`, expected one of `m`, `cm`, `mm`, `um`",
        ),
        (
            "noise = 0.1",
            "noise = 0.0",
            "`experiment.0.measured.0.noise` is malformed, expected a number, or 3 numbers",
        ),
        ("noise = 0.1", "nois = 0.1", "unknown field `nois`"),
        ("noise = 0.1", "nois = 0.1", "(did you mean `noise`?)"),
        ("columns = [\"x\", \"\", \"z\"]", "columns = [\"x\"]", "is 1 columns, expected 3 columns: x, y, z"),
        (
            "max = 2.0",
            "max = 0.2",
            "`parameter.0.max` is 0.2, expected a finite number above `min`, which is 0.5",
        ),
        ("min = 0.5", "min = -1", "`parameter.0.min` is -1, expected a number above 0"),
        ("measured.tip.delay_ms", "measured.top.delay_ms", "names the measured quantity `top`"),
        ("measured.tip.delay_ms", "measured.tip.lag", "is not `measured.NAME.` with"),
        ("measured.tip.delay_ms", "manipulator.stiffness_scale", "duplicate key"),
        ("tendon_force_n[0]", "tendon_forc_n[0]", "did you mean 'tendon_force_n'"),
        ("tendon_force_n[0]", "tendon_force_n", "expected one number of a command"),
        ("unit = \"mN\"", "unit = \"mm\"", "expected one of `N`, `mN`, `gf`"),
        ("time = \"t\"\n", "", "`experiment.0.commands.time` is missing"),
        ("time_unit = \"ms\"", "time_unit = \"min\"", "expected one of `s`, `ms`, `us`, `ns`"),
        ("sweep.csv", "sweep.mcap", "topic` is missing"),
        ("scene = \"sweep.toml\"\n", "", "`experiment.0.scene` is missing"),
        ("name = \"sweep\"", "name = \"a b\"", "1 to 64 letters"),
        ("file = \"sweep.csv\"\n", "", "file` is missing"),
        ("time = \"t\"", "time = \"t\"\nheld_out = true", "every experiment is held out"),
        ("frame = \"start\"", "frame = \"world\"", "unknown variant `world`"),
    ] {
        let text = STUDY.replacen(from, to, 1);
        assert_ne!(text, STUDY, "{from}");
        let error = parsed(&text).unwrap_err();
        assert!(error.contains(said), "{to}: {error}");
    }
}
