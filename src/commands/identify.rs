//! `trabecula identify`: fits parameters of scenes to measured files.

use std::path::{Path, PathBuf};

use clap::Args;
use ipc_types::process::EndRequest;
use serde_json::json;
use sim::SimError;
use sim::identification::OpenedStudy;

use crate::failure::{EXIT_INTERRUPTED, Failure};
use crate::identify::{check_text, design_text, fit_text, html};
use crate::output::{refuse_existing, within};
use crate::say::{Figures, merged, path_text};

/// Files of a fit.
const FILES: [&str; 3] = ["identified.toml", "identification.json", "report.html"];

/// Arguments of `identify`.
#[derive(Debug, Args)]
pub struct IdentifyArguments {
    /// Study file (TOML): parameters, experiments, measured columns.
    study: PathBuf,
    /// Folder for `identified.toml`, `identification.json` and `report.html`, or for synthetic measurements;
    /// created if missing.
    #[arg(short, long, default_value = "out/identification")]
    output: PathBuf,
    /// Compare once at the starting point, and print what is compared; write nothing.
    #[arg(long, group = "task")]
    check: bool,
    /// Write what the study's sensors would measure in its scenes, with noise, instead of fitting.
    #[arg(long, group = "task")]
    simulate: bool,
    /// Rank the study's candidate experiments by how much each would narrow the intervals; write nothing.
    #[arg(long, group = "task")]
    design: bool,
    #[command(flatten)]
    figures: Figures,
}

/// Fits, checks, simulates or ranks.
///
/// # Errors
/// Bad input (2); an unwritable file or a failed simulation (1); Ctrl-C (130).
pub fn run(arguments: &IdentifyArguments) -> Result<(), Failure> {
    let end = EndRequest::install().map_err(Failure::signals)?;
    let is_to_end = || end.is_set();
    match arguments {
        IdentifyArguments { check: true, .. } => {
            let study = OpenedStudy::open(&arguments.study).map_err(failed)?;
            let report = study.check(&is_to_end).map_err(failed)?;
            arguments.figures.say(|| check_text(&report), || json!(report));
        }
        IdentifyArguments { design: true, .. } => {
            let study = OpenedStudy::open(&arguments.study).map_err(failed)?;
            let report = study.plan(&is_to_end).map_err(failed)?;
            arguments.figures.say(|| design_text(&report), || json!(report));
        }
        IdentifyArguments { simulate: true, .. } => simulate(arguments, &is_to_end)?,
        _ => fit(arguments, &is_to_end)?,
    }
    Ok(())
}

fn failed(error: SimError) -> Failure {
    match error {
        SimError::Input(failure) => failure,
        SimError::GivenUp { .. } => {
            Failure { message: "interrupted; nothing was written".to_owned(), code: EXIT_INTERRUPTED }
        }
        other => Failure::by_kind(!other.is_of_the_machine(), other),
    }
}

fn fit(arguments: &IdentifyArguments, is_to_end: &(dyn Fn() -> bool + Sync)) -> Result<(), Failure> {
    let folder = &arguments.output;
    let files = within(folder, &FILES);
    refuse_existing(&files)?;
    let study = OpenedStudy::open(&arguments.study).map_err(failed)?;
    let report = study.identify(is_to_end).map_err(failed)?;
    let name = arguments.study.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let page = html(&name, &report)?;
    let text = serde_json::to_vec_pretty(&report).map_err(Failure::failed)?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    let contents = [report.toml.clone().into_bytes(), text, page.into_bytes()];
    output_file::write_all(&files.into_iter().zip(contents).collect::<Vec<_>>())?;
    arguments.figures.say(
        || {
            let [first, others @ ..] = FILES;
            let place = folder.join(first);
            format!("{}\nwritten      {}, {}", fit_text(&report), place.display(), others.join(", "))
        },
        || merged(json!(report), json!({"output": path_text(folder)})),
    );
    Ok(())
}

fn simulate(arguments: &IdentifyArguments, is_to_end: &(dyn Fn() -> bool + Sync)) -> Result<(), Failure> {
    let folder = &arguments.output;
    let study = OpenedStudy::open_without_measurements(&arguments.study).map_err(failed)?;
    let planned: Vec<PathBuf> = study.synthetic_names().iter().map(|name| folder.join(name)).collect();
    refuse_existing(&planned)?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    let files = study.simulate(folder, is_to_end).map_err(failed)?;
    let contents: Vec<(PathBuf, Vec<u8>)> =
        files.into_iter().map(|file| (folder.join(file.name), file.csv.into_bytes())).collect();
    output_file::write_all(&contents)?;
    let names: Vec<&Path> = contents.iter().map(|(path, _)| path.as_path()).collect();
    arguments.figures.say(
        || {
            let lines = names.iter().map(|name| format!("written      {}", name.display()));
            lines.collect::<Vec<_>>().join("\n")
        },
        || json!({"files": names.iter().map(|name| path_text(name)).collect::<Vec<_>>()}),
    );
    Ok(())
}
