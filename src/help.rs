//! What every `--help` ends with: examples and exit codes. Both programs' command lines are completed here, so that no command is without.

use clap::Command;

use crate::program::EXIT_CODES;

/// Examples of a command: its path such as `log export`, and lines that begin with the program's name.
pub type Examples = (&'static str, &'static [&'static str]);

/// The command line with examples and exit codes in the help of each of its commands.
pub fn completed(command: Command, examples: &'static [Examples]) -> Command {
    below(command.after_help(EXIT_CODES), "", examples)
}

fn below(command: Command, path: &str, examples: &'static [Examples]) -> Command {
    command.mut_subcommands(|command| {
        let path = format!("{path} {}", command.get_name()).trim_start().to_owned();
        let lines = examples.iter().find(|(of, _)| *of == path).map(|(_, lines)| *lines);
        let text = match lines {
            Some(lines) => format!("Examples:\n  {}\n\n{EXIT_CODES}", lines.join("\n  ")),
            None => EXIT_CODES.to_owned(),
        };
        below(command.after_help(text), &path, examples)
    })
}

/// The examples of `trabecula`.
pub const EXAMPLES: &[Examples] = &[
    (
        "run",
        &[
            "trabecula run",
            "trabecula run scene.toml --mode lockstep --set run.duration_s=2",
            "trabecula run scene.toml --view",
        ],
    ),
    (
        "replay",
        &[
            "trabecula replay out/run --verify",
            "trabecula replay out/run --from 1.5s --to 2s --verify --frames",
        ],
    ),
    (
        "view",
        &[
            "trabecula view",
            "trabecula view out/run",
            "trabecula view out/run out/other --port 0 --no-open",
            "trabecula view scene.toml",
        ],
    ),
    (
        "sweep run",
        &[
            "trabecula sweep run sweep.toml",
            "trabecula sweep run sweep.toml --jobs 2 --shard 0/4 -o out/sweep",
        ],
    ),
    ("sweep list", &["trabecula sweep list sweep.toml -o out/sweep"]),
    ("sweep gather", &["trabecula sweep gather out/a out/b -o sweep.parquet"]),
    ("sweep report", &["trabecula sweep report out/sweep --of target_error_mm --of bend_deg"]),
    ("sweep plot", &["trabecula sweep plot out/sweep --of target_error_mm -o sweep"]),
    (
        "bridge igtl",
        &["trabecula bridge igtl", "trabecula bridge igtl --controller plan --control-token-file token.txt"],
    ),
    (
        "bridge ros2",
        &["trabecula bridge ros2", "trabecula bridge ros2 --controller ros --rate 100 --domain-id 7"],
    ),
    (
        "plot",
        &[
            "trabecula plot out/run bend_rad tendon_tension_n[0]",
            "trabecula plot out/run t_world_tip.position_m -o tip",
        ],
    ),
    ("log info", &["trabecula log info out/run", "trabecula log info out/run --json"]),
    (
        "log cat",
        &["trabecula log cat out/run --topic /state --field t_world_tip.position_m --from 100 --to 200"],
    ),
    ("log diff", &["trabecula log diff out/run out/other"]),
    ("log repair", &["trabecula log repair out/run -o whole.mcap"]),
    ("log compress", &["trabecula log compress out/run -o small.mcap --method zstd --level 9"]),
    (
        "log export",
        &[
            "trabecula log export out/run -o state.parquet",
            "trabecula log export out/run -o pictures --frames",
            "trabecula log export out/run -o tunnel.stl --geometry tunnel",
            "trabecula log export out/run -o dataset --dataset coco",
            "trabecula log export out/run -o deviation.vtp --geometry deviation",
        ],
    ),
    ("log cat-files", &["trabecula log cat-files out/run out/other -o both.mcap"]),
    ("log split", &["trabecula log split both.mcap -o runs"]),
    ("calibrate", &["trabecula calibrate", "trabecula calibrate sweep.toml -o out/sweep"]),
    (
        "plan",
        &[
            "trabecula plan scene.toml",
            "trabecula plan --check out/run",
            "trabecula plan --list",
            "trabecula plan --list scene.toml",
        ],
    ),
    ("scene check", &["trabecula scene check scene.toml"]),
    ("scene init", &["trabecula scene init -o my_scenes", "trabecula scene init --scene free_space"]),
    (
        "scene from-markups",
        &[
            "trabecula scene from-markups plan.mrk.json --ct ct.nrrd -o hip.toml",
            "trabecula scene from-markups plan.fcsv --ct bones.seg.nrrd --segment femur",
        ],
    ),
    (
        "scene show",
        &["trabecula scene show scene.toml -o plan.png", "trabecula scene show -o femur.png --json"],
    ),
    ("scene schema", &["trabecula scene schema"]),
    ("volume info", &["trabecula volume info ct.nii.gz", "trabecula volume info dicom_folder --json"]),
    (
        "volume probe",
        &[
            "trabecula volume probe ct.nii.gz --at=-99.1,-143.6,116.6",
            "trabecula volume probe ct.nii.gz --ras --at=99.1,143.6,116.6 --at=95,143.6,116.6",
        ],
    ),
    ("volume drilled", &["trabecula volume drilled out/run -o drilled.nrrd --tick 5000"]),
    ("phantom", &["trabecula phantom femur -o femur.nrrd", "trabecula phantom pelvis -o pelvis.nrrd"]),
    (
        "drr",
        &["trabecula drr ct.nii.gz -o ap.png", "trabecula drr ct.nii.gz --sweep 180 --animate -o sweep.png"],
    ),
    ("docs messages", &["trabecula docs messages"]),
    ("docs scene", &["trabecula docs scene"]),
    ("docs schema", &["trabecula docs schema State"]),
    ("docs completions", &["trabecula docs completions bash"]),
    ("docs man", &["trabecula docs man"]),
    (
        "docs install",
        &["trabecula docs install -o ~/.local", "trabecula docs install -o debian/trabecula/usr"],
    ),
    ("session list", &["trabecula session list", "trabecula session list --json"]),
    ("session stop", &["trabecula session stop"]),
    ("session pause", &["trabecula session pause"]),
    ("session resume", &["trabecula session resume"]),
    ("session env", &["trabecula session env"]),
    ("stress", &["trabecula stress --cores 1,2", "trabecula stress scene.toml --load none,spin:2 -o out"]),
    ("cache info", &["trabecula cache info", "trabecula cache info --json"]),
    ("cache clear", &["trabecula cache clear"]),
    (
        "tool show",
        &["trabecula tool show configs/tools/two_segments.toml", "trabecula tool show scene.toml --json"],
    ),
    ("doctor", &["trabecula doctor", "trabecula doctor --json --seconds 5"]),
];
