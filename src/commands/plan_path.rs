//! `trabecula plan path SCENE`: searches approaches to a target that keep away from structures and remove
//! little bone.

use std::path::PathBuf;

use clap::Args;
use foreign_text::counted;
use ipc_types::process::EndRequest;
use serde_json::{Value, json};
use sweep::Proportion;

use crate::failure::Failure;
use crate::launcher::volume_source::VolumeFiles;
use crate::output::{OutputFolder, refuse_existing};
use crate::plan_edit::rounded;
use crate::plan_path::{self, Bounds, Candidate, Offsets, Risk, Search, Settings, Uncertainty};
use crate::report::ReportError;
use crate::say::{Figures, path_text};
use crate::scenes::{BuiltIn, SceneSource};

/// Largest number of candidates of a search: all their draws fit the Sobol sequence.
const MAX_CANDIDATES: u64 = 2000;
/// Largest number of plans that are written.
const MAX_PLANS: u64 = 20;
/// Largest number of sampled runs of a plan.
const MAX_SAMPLES: u64 = 10_000;
/// Name of the picture.
const PICTURE: &str = "plans.png";

/// Arguments of `plan path`.
#[derive(Debug, Args)]
pub struct PathArguments {
    /// Scene file; default: the built-in femur.
    scene: Option<PathBuf>,
    /// Folder for the plans (`plan-1.toml` and so on) and the picture `plans.png`; created if missing.
    #[arg(short, long, default_value = "out/plans")]
    output: PathBuf,
    /// Move the entry by up to this much, in both directions across the feed.
    #[arg(long, value_name = "MM", default_value_t = 3.0)]
    #[arg(value_parser = within(0.0, 50.0), allow_negative_numbers = true)]
    entry_mm: f64,
    /// Tilt the feed by up to this much, in both directions; a straight path always aims at its target.
    #[arg(long, value_name = "DEG", default_value_t = 4.0)]
    #[arg(value_parser = within(0.0, 45.0), allow_negative_numbers = true)]
    tilt_deg: f64,
    /// Begin the bend up to this much earlier or later along the feed.
    #[arg(long, value_name = "MM", default_value_t = 2.0)]
    #[arg(value_parser = within(0.0, 50.0), allow_negative_numbers = true)]
    bend_mm: f64,
    /// Change the final tension by up to this much, beyond what the angle of the bend needs.
    #[arg(long, value_name = "PERCENT", default_value_t = 10.0)]
    #[arg(value_parser = within(0.0, 90.0), allow_negative_numbers = true)]
    tension_percent: f64,
    /// Feed up to this much shorter or longer than the planned path.
    #[arg(long, value_name = "MM", default_value_t = 0.5)]
    #[arg(value_parser = within(0.0, 20.0), allow_negative_numbers = true)]
    feed_mm: f64,
    /// Largest number of paths to simulate, the scene's own included.
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u64).range(1..=MAX_CANDIDATES))]
    candidates: u64,
    /// Largest number of plans to write.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=MAX_PLANS))]
    plans: u64,
    /// Number of sampled runs of each plan, for its probabilities, at most the points of the study; 0 for
    /// none.
    #[arg(long, default_value_t = 15, value_parser = clap::value_parser!(u64).range(0..=MAX_SAMPLES))]
    samples: u64,
    /// Sweep study (TOML) whose points are the sampled worlds. It may only set keys of `[truth]`; its scene
    /// is not used.
    /// Default: the registration by up to 1 mm and 1 deg about each axis, the tool's stiffness by 10 %, the
    /// tendons' friction from 0 to 0.2.
    #[arg(long, value_name = "FILE")]
    study: Option<PathBuf>,
    /// Seed of the search.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    #[command(flatten)]
    volume_files: VolumeFiles,
    #[command(flatten)]
    figures: Figures,
}

/// Returns a parser of a number within a range.
fn within(low: f64, high: f64) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync + 'static {
    move |text: &str| match text.parse::<f64>() {
        Ok(number) if (low..=high).contains(&number) => Ok(number),
        _ => Err(format!("expected a number from {low} to {high}")),
    }
}

/// Searches and writes the plans.
///
/// # Errors
/// Bad input or an existing output (2); no path without a fault, or an unwritable file (1); Ctrl-C (130).
pub fn run(arguments: &PathArguments) -> Result<(), Failure> {
    let folder = &arguments.output;
    let file = |number: usize| folder.join(format!("plan-{}.toml", number + 1));
    let mut files: Vec<PathBuf> = (0..arguments.plans as usize).map(file).collect();
    files.push(folder.join(PICTURE));
    refuse_existing(&files)?;
    let _created = OutputFolder::of(&folder.join(PICTURE))?;
    let end = EndRequest::install().map_err(Failure::signals)?;
    let is_to_end = || end.is_set();
    let uncertainty = Uncertainty::read(arguments.study.as_deref())?;
    let source = SceneSource::new(arguments.scene.as_deref(), BuiltIn::Femur);
    let search = Search::new(&source, settings(arguments), &is_to_end)?;
    search.check(&uncertainty)?;
    let candidates = search.run(&|found: &[Candidate]| tell!("simulated {}", tally(found)))?;
    let plans = plan_path::spread(&plan_path::front(&candidates), arguments.plans as usize);
    if plans.is_empty() {
        return Err(Failure::failed(format!(
            "{source}: no path without a fault: of {}; widen the bounds, or raise --candidates",
            tally(&candidates)
        )));
    }
    let chosen: Vec<&Candidate> = plans.iter().map(|index| &candidates[*index]).collect();
    if arguments.samples > 0 {
        tell!("{}", uncertainty.progress(chosen.len(), arguments.samples));
    }
    let risks = search.risks(&chosen, &uncertainty, arguments.samples)?;
    let picture = plan_path::draw(&search.scene().name, &candidates, &plans)
        .and_then(|figure| figure.png(&folder.join(PICTURE)))
        .map_err(ReportError::from)?;
    let mut contents: Vec<(PathBuf, Vec<u8>)> = chosen
        .iter()
        .enumerate()
        .map(|(number, plan)| (file(number), plan.text.clone().into_bytes()))
        .collect();
    contents.push((folder.join(PICTURE), picture));
    output_file::write_all(&contents)?;
    let written =
        Written { arguments, search: &search, candidates: &candidates, plans: &chosen, risks: &risks };
    arguments.figures.say(|| written.text(), || written.json());
    Ok(())
}

fn settings(arguments: &PathArguments) -> Settings {
    let PathArguments { entry_mm, tilt_deg, bend_mm, tension_percent, feed_mm, .. } = *arguments;
    Settings {
        bounds: Bounds { entry_mm, tilt_deg, bend_mm, tension_percent, feed_mm },
        candidates: arguments.candidates as usize,
        seed: arguments.seed,
        volume_files: arguments.volume_files,
    }
}

/// Returns the number of simulated paths, and how many have which fault.
fn tally(found: &[Candidate]) -> String {
    let good = found.iter().filter(|candidate| candidate.outcome.fault.is_none()).count();
    let faults = plan_path::faults(found).into_iter().map(|(fault, count)| (count, fault.verb(count)));
    let parts = std::iter::once((good, "without a fault")).chain(faults);
    let parts: Vec<String> = parts.map(|(count, what)| format!("{count} {what}")).collect();
    format!("{}: {}", counted(found.len(), "path"), parts.join(", "))
}

/// The result of a search.
struct Written<'a> {
    arguments: &'a PathArguments,
    search: &'a Search<'a>,
    candidates: &'a [Candidate],
    plans: &'a [&'a Candidate],
    risks: &'a [Risk],
}

impl Written<'_> {
    fn text(&self) -> String {
        let mut lines = Vec::new();
        if self.search.has_added_outside {
            let from = "none to avoid: the clearance is that from the outside of the bone";
            lines.push(format!("structures   {from}"));
        }
        lines.push(format!("simulated    {}", tally(self.candidates)));
        lines.extend(HEAD.map(|head| line(head.map(str::to_owned))));
        lines.extend(self.candidates.iter().take(1).map(|own| row("scene", own, None)));
        let plans = self.plans.iter().zip(self.risks).enumerate();
        lines.extend(plans.map(|(number, (plan, risk))| row(&(number + 1).to_string(), plan, Some(risk))));
        lines.extend(self.risks.iter().enumerate().filter_map(|(number, risk)| {
            Some(format!("no result    plan {}: {}", number + 1, risk.without_result()?))
        }));
        lines.push(format!(
            "written      {} and {PICTURE} in {}",
            counted(self.plans.len(), "plan"),
            self.arguments.output.display()
        ));
        lines.join("\n")
    }

    fn json(&self) -> Value {
        let plan = |(number, (plan, risk)): (usize, (&&Candidate, &Risk))| {
            json!({
                "file": path_text(&self.arguments.output.join(format!("plan-{}.toml", number + 1))),
                "plan": plan,
                "risk": risk,
                "breach_interval": risk.breach.interval(),
                "miss_interval": risk.miss.interval(),
            })
        };
        let plans = self.plans.iter().zip(self.risks).enumerate().map(plan);
        json!({
            "scene": self.search.scene().name,
            "picture": path_text(&self.arguments.output.join(PICTURE)),
            "has_added_outside": self.search.has_added_outside,
            "plans": plans.collect::<Vec<_>>(),
            "candidates": self.candidates,
        })
    }
}

/// Columns of the table, with their units.
const HEAD: [[&str; 10]; 2] = [
    ["plan", "clearance", "removed", "off", "entry", "tilt", "bend", "tension", "feed", "breach, miss"],
    ["", "mm", "mm3", "mm", "mm", "deg", "mm", "%", "mm", "shares with 95 % intervals"],
];

/// Returns a line of the table.
fn line(cells: [String; 10]) -> String {
    const WIDTHS: [usize; 10] = [6, 11, 9, 6, 13, 13, 7, 9, 7, 0];
    let padded = cells.iter().zip(WIDTHS).map(|(cell, width)| format!("{cell:<width$}"));
    padded.collect::<String>().trim_end().to_owned()
}

/// Returns the line of a path; one without a risk has its fault instead, if any.
fn row(name: &str, path: &Candidate, risk: Option<&Risk>) -> String {
    let outcome = &path.outcome;
    let Offsets { entry_mm, tilt_deg, bend_mm, tension_percent, feed_mm } = path.offsets;
    let number = |x: Option<f64>| x.map_or("-".to_owned(), |x| format!("{:.2}", rounded(x, 2)));
    let pair = |[a, b]: [f64; 2]| format!("{} {}", signed(a, 2), signed(b, 2));
    line([
        name.to_owned(),
        number(outcome.clearance_mm),
        format!("{:.1}", outcome.bone_removed_mm3),
        number(outcome.target_error_mm),
        pair(entry_mm),
        pair(tilt_deg),
        signed(bend_mm, 2),
        signed(tension_percent, 1),
        signed(feed_mm, 2),
        match (risk, outcome.fault) {
            (Some(risk), _) => format!("{}, {}", proportion(risk.breach), proportion(risk.miss)),
            (None, Some(fault)) => fault.verb(1).to_owned(),
            (None, None) => String::new(),
        },
    ])
}

/// Formats a number with its sign; a rounded zero has a plus.
fn signed(x: f64, decimals: u8) -> String {
    format!("{:+.*}", decimals.into(), rounded(x, decimals.into()))
}

fn proportion(of: Proportion) -> String {
    if of.of == 0 {
        return "-".to_owned();
    }
    let [low, high] = of.interval();
    format!("{:.2} ({low:.2} to {high:.2})", of.count as f64 / of.of as f64)
}
