//! The tools compared by a measurement: those of given files, or the shipped ones.

use std::path::{Path, PathBuf};

use ipc_types::scene::{Scene, ToolDescription};
use simulation::manipulator::ManipulatorParameters;
use simulation::manipulator_parameters;
use trabecula::failure::Failure;
use trabecula::scenes::BuiltIn;
use trabecula::tool::source::ToolSource;

/// Name and text of the compared files of `configs/tools`, the standard tool first.
const SHIPPED: [(&str, &str); 6] = [
    ("jhu_27", include_str!("../../configs/tools/jhu_27.toml")),
    ("two_segments", include_str!("../../configs/tools/two_segments.toml")),
    ("steerable_drill", include_str!("../../configs/tools/steerable_drill.toml")),
    ("ct_sdr", include_str!("../../configs/tools/ct_sdr.toml")),
    ("tube_in_tube", include_str!("../../configs/tools/tube_in_tube.toml")),
    ("rigid_drill", include_str!("../../configs/tools/rigid_drill.toml")),
];

/// A tool and its name in tables.
#[derive(Debug, Clone)]
pub struct NamedTool {
    /// Name in tables: a shipped tool's name, or the file as given.
    pub name: String,
    /// The tool.
    pub parameters: ManipulatorParameters,
}

/// Returns the tools of scene or tool files; without files, the shipped ones.
///
/// # Errors
/// Bad input: a file that is neither a scene nor a tool.
pub fn tools(files: &[PathBuf]) -> Result<Vec<NamedTool>, Failure> {
    if files.is_empty() {
        return SHIPPED.into_iter().map(shipped).collect();
    }
    let of_file = |file: &PathBuf| {
        let source = ToolSource::load(Some(file))?;
        let parameters = half_out(&source.scene)?;
        Ok(NamedTool { name: source.to_string(), parameters })
    };
    files.iter().map(of_file).collect()
}

fn shipped((name, text): (&str, &str)) -> Result<NamedTool, Failure> {
    let mut scene = BuiltIn::FreeSpace.scene()?;
    scene.manipulator.tool = Some(ToolDescription::parse(text, Path::new(name)).map_err(Failure::bad_input)?);
    Ok(NamedTool { name: name.to_owned(), parameters: half_out(&scene)? })
}

/// Returns a scene's tool. A tool that slides out of an outer tube is placed half out, by moving the end of
/// that tube toward the tool's base.
fn half_out(scene: &Scene) -> Result<ManipulatorParameters, Failure> {
    let mut parameters = manipulator_parameters(scene).map_err(Failure::bad_input)?;
    if let (Some(outer), Some(described)) = (&mut parameters.outer_tube, scene.manipulator.outer_tube()) {
        outer.end_m -= 0.5e-3 * described.travel_mm;
    }
    Ok(parameters)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn every_tool_of_the_folder_is_among_the_shipped_ones() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/tools");
        let mut files: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().path().file_stem().unwrap().to_str().unwrap().to_owned())
            .collect();
        let mut names: Vec<String> = tools(&[]).unwrap().into_iter().map(|tool| tool.name).collect();
        files.sort();
        names.sort();
        assert_eq!(names, files);
    }
}
