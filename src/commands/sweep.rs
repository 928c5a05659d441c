//! `trabecula sweep`: runs a scene many times with varied parameters and reports which ones matter.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::{Args, Subcommand};
use foreign_text::foreign_path;
use ipc_types::process::EndRequest;
use serde_json::json;

use crate::failure::{EXIT_INTERRUPTED, Failure};
use crate::output::{figure_place, refuse_existing};
use crate::say::{Figures, path_text};
use crate::sweep::folder::{Folder, OpenedStudy, joined};
use crate::sweep::parquet::table;
use crate::sweep::report;
use crate::sweep::row::{Ending, Row};
use crate::sweep::runner::{self, Progress, Shard, Work};

/// Maximum number of concurrent runs.
const MAX_JOBS: u64 = 1024;

/// Arguments of `sweep`.
#[derive(Debug, Subcommand)]
pub enum SweepCommand {
    /// Run the points of a study that have no row yet; write one row per point and a Parquet table.
    Run(RunArguments),
    /// Print one command per point, to run in any order on any machines that share the folder.
    List(ListArguments),
    /// Merge the rows of a study from one or more folders into a Parquet table.
    Gather(GatherArguments),
    /// Print how a result depends on each parameter: rank correlations, and Sobol indices for a Saltelli
    /// design.
    Report(ReportArguments),
    /// Plot a result against each parameter.
    Plot(PlotArguments),
}

/// Arguments of `sweep run`.
#[derive(Debug, Args)]
pub struct RunArguments {
    /// Study file (TOML): scene, parameters, design.
    study: PathBuf,
    /// Folder of the sweep, new or from the same study; default: `out/` and the study's name.
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// Number of concurrent runs; default: one per core.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=MAX_JOBS))]
    jobs: Option<u64>,
    /// Run only the points whose number modulo N is I.
    #[arg(long, value_name = "I/N", conflicts_with = "point")]
    shard: Option<Shard>,
    /// Run only this point (may be repeated); writes its row but no table.
    #[arg(long, value_name = "NUMBER")]
    point: Vec<u64>,
    /// Print no line per run.
    #[arg(long)]
    quiet: bool,
    #[command(flatten)]
    figures: Figures,
}

/// Arguments of `sweep list`.
#[derive(Debug, Args)]
pub struct ListArguments {
    /// Study file (TOML).
    study: PathBuf,
    /// Folder of the sweep in the commands; default: `out/` and the study's name. Nothing is written.
    #[arg(short, long)]
    output: Option<PathBuf>,
}

/// Arguments of `sweep gather`.
#[derive(Debug, Args)]
pub struct GatherArguments {
    /// Sweep folders of the same study.
    #[arg(required = true)]
    folders: Vec<PathBuf>,
    /// New `.parquet` file.
    #[arg(short, long)]
    output: PathBuf,
    #[command(flatten)]
    figures: Figures,
}

/// Arguments of `sweep report`.
#[derive(Debug, Args)]
pub struct ReportArguments {
    /// Folder of the sweep.
    folder: PathBuf,
    /// Result to analyse, a column of the rows (may be repeated).
    #[arg(long, value_name = "FIGURE", default_value = "target_error_mm")]
    of: Vec<String>,
    #[command(flatten)]
    figures: Figures,
}

/// Arguments of `sweep plot`.
#[derive(Debug, Args)]
pub struct PlotArguments {
    /// Folder of the sweep.
    folder: PathBuf,
    /// Result to plot, a column of the rows.
    #[arg(long, value_name = "FIGURE", default_value = "target_error_mm")]
    of: String,
    /// Path of the plot, with or without its extension; `.png` and `.svg` are written.
    #[arg(short, long, default_value = "sweep")]
    output: PathBuf,
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Shard, String> {
        let numbers = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match numbers {
            Some((index, of)) if index < of && of <= 1_000_000 => Ok(Shard { index, of }),
            _ => Err("expected I/N with I from 0 to N - 1, such as 0/4".to_owned()),
        }
    }
}

/// Runs the command.
///
/// # Errors
/// Bad input (2); a row, log or plot that cannot be written (1); Ctrl-C (130, and finished rows are kept).
pub fn run(command: &SweepCommand) -> Result<(), Failure> {
    match command {
        SweepCommand::Run(arguments) => run_points(arguments),
        SweepCommand::List(arguments) => list(arguments),
        SweepCommand::Gather(arguments) => gather(arguments),
        SweepCommand::Report(arguments) => print_report(arguments),
        SweepCommand::Plot(arguments) => plot(arguments),
    }
}

/// Returns the given folder, or `out/` with the study's name.
fn folder_of(output: Option<&Path>, study: &Path) -> PathBuf {
    let named = || Path::new("out").join(study.file_stem().unwrap_or_default());
    output.map_or_else(named, Path::to_owned)
}

fn run_points(arguments: &RunArguments) -> Result<(), Failure> {
    let end = EndRequest::install().map_err(Failure::signals)?;
    let study = OpenedStudy::read(&arguments.study)?;
    study.refuse_external()?;
    let count = study.study.count();
    if let Some(point) = arguments.point.iter().find(|point| **point >= count) {
        return Err(Failure::bad_input(format!(
            "--point {point}: the study has {}, expected 0 to {}",
            foreign_text::counted(count, "point"),
            count - 1
        )));
    }
    let shard = arguments.shard.unwrap_or(Shard { index: 0, of: 1 });
    let points: Vec<u64> = match arguments.point.is_empty() {
        true => shard.points(count).collect(),
        false => arguments.point.iter().copied().collect::<BTreeSet<u64>>().into_iter().collect(),
    };
    let cores = || std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let jobs = arguments.jobs.map_or_else(cores, |jobs| jobs as usize);
    let folder = Folder::take(&folder_of(arguments.output.as_deref(), &arguments.study), &study)?;
    let told = |row: &Row, progress: Progress| {
        if !arguments.quiet {
            tell!("{}", line(row, progress, jobs));
        }
    };
    let ran = runner::run(&study, &folder, &Work { points: points.clone(), jobs }, &|| end.is_set(), &told);
    // Write the table of the finished points however the sweep ended.
    let rows = points.iter().filter_map(|&point| folder.row(point).transpose());
    let rows = rows.collect::<Result<Vec<Row>, Failure>>()?;
    let table = match arguments.point.is_empty() {
        true => Some(folder.write_table(&shard.table(), &rows)?),
        false => None,
    };
    ran?;
    let completed = rows.iter().filter(|row| row.outcome == Ending::Completed).count();
    arguments.figures.say(
        || {
            let table =
                table.as_ref().map_or(String::new(), |table| format!("\ntable        {}", table.display()));
            format!(
                "rows         {} of {}, {completed} completed\nfolder       {}{table}",
                rows.len(),
                points.len(),
                folder.path().display()
            )
        },
        || {
            json!({
                "folder": path_text(folder.path()), "rows": rows.len(), "of": points.len(),
                "completed": completed, "table": table.as_deref().map(path_text),
            })
        },
    );
    match rows.len() == points.len() {
        true => Ok(()),
        false => Err(Failure {
            message: format!(
                "interrupted with {} of {} points done; run the same command to continue",
                rows.len(),
                points.len()
            ),
            code: EXIT_INTERRUPTED,
        }),
    }
}

/// Formats the line of a finished run.
fn line(row: &Row, progress: Progress, jobs: usize) -> String {
    let error = row.figure("target_error_mm").map_or(String::new(), |mm| format!("  {mm:8.3} mm off target"));
    let reason = row.reason.as_ref().map_or(String::new(), |reason| format!("  {reason}"));
    let each_s = progress.elapsed_s / progress.made.max(1) as f64;
    // No more runs at once than there are points.
    let at_once = jobs.min(usize::try_from(progress.made + progress.of - progress.done).unwrap_or(jobs));
    let left_s = each_s * (progress.of - progress.done) as f64;
    let left = if progress.done < progress.of { format!(", {left_s:.0} s left") } else { String::new() };
    format!(
        "{} of {}  point {}  {}{error}{reason}  ({:.2} s per run{left})",
        progress.done,
        progress.of,
        row.point,
        row.outcome.name(),
        each_s * at_once as f64,
    )
}

fn list(arguments: &ListArguments) -> Result<(), Failure> {
    let study = OpenedStudy::read(&arguments.study)?;
    let absolute = |path: &Path| {
        let path = std::path::absolute(path).map_err(Failure::failed)?;
        Ok::<String, Failure>(path.display().to_string())
    };
    let file = absolute(&arguments.study)?;
    let folder = absolute(&folder_of(arguments.output.as_deref(), &arguments.study))?;
    let own = std::env::current_exe().map_err(Failure::failed)?;
    let own = own.display().to_string();
    for point in 0..study.study.count() {
        let point = point.to_string();
        let words =
            [&own, "sweep", "run", &file, "--jobs", "1", "--quiet", "--point", &point, "--output", &folder];
        say!("{}", joined(&words.map(str::to_owned))?);
    }
    Ok(())
}

fn gather(arguments: &GatherArguments) -> Result<(), Failure> {
    let output = &arguments.output;
    refuse_existing(&[output])?;
    if output.extension().is_none_or(|ending| ending != "parquet") {
        return Err(Failure::bad_input(format!(
            "--output is {}, expected a .parquet file",
            output.display()
        )));
    }
    let folders =
        arguments.folders.iter().map(|folder| Folder::open(folder)).collect::<Result<Vec<_>, _>>()?;
    let Some(first) = folders.first() else {
        return Err(Failure::bad_input("expected at least one folder"));
    };
    if let Some(other) = folders.iter().find(|folder| !folder.is_of_the_same(first)) {
        return Err(Failure::bad_input(format!(
            "{} and {} are from different studies, scenes or builds and cannot be merged into one table",
            foreign_path(first.path()),
            foreign_path(other.path())
        )));
    }
    let mut rows = Vec::new();
    for point in 0..first.count() {
        let found = folders.iter().map(|folder| folder.row(point)).collect::<Result<Vec<_>, _>>()?;
        let mut found = found.into_iter().flatten();
        let Some(row) = found.next() else { continue };
        if let Some(other) = found.find(|other| other.final_hash != row.final_hash) {
            let hash = |row: &Row| row.final_hash.clone().unwrap_or_else(|| row.outcome.name().to_owned());
            return Err(Failure::failed(format!(
                "point {point} has different results in two folders, {} and {}; rerun its command on both \
                 machines",
                hash(&row),
                hash(&other)
            )));
        }
        rows.push(row);
    }
    output_file::write(output, table(first.keys(), &rows)?)?;
    arguments.figures.say(
        || format!("rows         {} of {}\ntable        {}", rows.len(), first.count(), output.display()),
        || json!({"rows": rows.len(), "of": first.count(), "table": path_text(output)}),
    );
    Ok(())
}

fn print_report(arguments: &ReportArguments) -> Result<(), Failure> {
    arguments.of.iter().try_for_each(|name| report::check_figure(name))?;
    let folder = Folder::open(&arguments.folder)?;
    let rows = folder.rows()?;
    let found = arguments.of.iter().map(|name| {
        report::sensitivity(folder.study(), &rows, name).ok_or_else(|| {
            Failure::failed(format!(
                "{}: none of the {} rows has a value of {name}",
                foreign_path(folder.path()),
                rows.len()
            ))
        })
    });
    let found = found.collect::<Result<Vec<_>, _>>()?;
    arguments.figures.say(
        || found.iter().map(report::Sensitivity::text).collect::<Vec<_>>().join("\n\n"),
        || json!({"figures": found}),
    );
    Ok(())
}

fn plot(arguments: &PlotArguments) -> Result<(), Failure> {
    report::check_figure(&arguments.of)?;
    let folder = Folder::open(&arguments.folder)?;
    let rows = folder.rows()?;
    let place = figure_place(&arguments.output)?;
    place.write(report::draw(folder.study(), &rows, &arguments.of))?;
    say!("written      {}, .svg", place.files[0].display());
    Ok(())
}
