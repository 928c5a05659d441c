//! Writes a scene as an FMU.

use std::path::Path;
use std::sync::Arc;

use messages::layout::fingerprint;
use sim::{Drive, SharedScene, Sim};

use crate::archive::Archive;
use crate::description::{MODEL, Model, Version, model_description};
use crate::error::FmuError;
use crate::variables::Variables;

/// The scene in an FMU's resources.
pub(crate) const SCENE_FILE: &str = "scene.toml";
/// Names of the controllers that the master drives, one in a line, in an FMU's resources.
pub(crate) const DRIVE_FILE: &str = "drive.txt";

/// An FMU as bytes, and what its user should know.
#[derive(Debug)]
pub struct Fmu {
    /// The archive.
    pub bytes: Vec<u8>,
    /// Files of the scene that the FMU refers to by their path, because they consist of several files.
    pub outside: Vec<String>,
}

/// Returns the token that ties a model description to its resources and this build's messages.
pub(crate) fn token(scene: &str, drive: &str) -> String {
    let version = env!("CARGO_PKG_VERSION");
    let layouts: String = messages::ALL.iter().map(|message| message.layout_hash()).collect();
    fingerprint(&format!("{version}\n{layouts}\n{drive}\n{scene}"))
}

/// Returns what a scene's model description says, beside its variables.
pub(crate) fn model(sim: &Sim, token: String) -> Model {
    let scene = sim.shared().scene();
    Model {
        name: scene.name.clone(),
        description: scene.description.clone(),
        token,
        tool: format!("Trabecula {}", env!("CARGO_PKG_VERSION")),
        dt_s: scene.dt_s(),
        stop_s: scene.tick_count() as f64 * scene.dt_s(),
    }
}

/// Suffixes of headers that name further files: the FMU refers to them by their path.
const HEADERS: [&str; 3] = ["nhdr", "mhd", "urdf"];

/// Replaces paths of single files by names in the resources; lists the paths of everything else.
fn take_files(
    value: &mut toml::Value,
    files: &mut Vec<(String, Vec<u8>)>,
    outside: &mut Vec<String>,
) -> Result<(), FmuError> {
    match value {
        toml::Value::Table(table) => {
            table.iter_mut().try_for_each(|(_, value)| take_files(value, files, outside))
        }
        toml::Value::Array(items) => items.iter_mut().try_for_each(|value| take_files(value, files, outside)),
        toml::Value::String(text) => {
            let path = Path::new(text.as_str());
            if !path.is_absolute() || !path.exists() {
                return Ok(());
            }
            let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
            let Some(name) =
                path.file_name().filter(|_| path.is_file() && !HEADERS.contains(&extension.as_str()))
            else {
                outside.push(text.clone());
                return Ok(());
            };
            let content = std::fs::read(path)
                .map_err(|cause| FmuError::File { path: text.clone(), reason: cause.to_string() })?;
            let name = format!("{}_{}", files.len(), name.to_string_lossy());
            files.push((name.clone(), content));
            *text = name;
            Ok(())
        }
        _ => Ok(()),
    }
}

/// Writes a scene as an FMU; `drive` are the controllers that the master drives, `library` is this library's
/// file. The same inputs give the same bytes.
///
/// # Errors
/// If the scene cannot be simulated, a file cannot be read, or the FMU would exceed 4 GiB.
pub fn fmu(
    shared: &Arc<SharedScene>,
    drive: &Drive,
    version: Version,
    library: &Path,
) -> Result<Fmu, FmuError> {
    let sim = Sim::new(shared, drive)?;
    let unwritable = |cause: &dyn std::fmt::Display| sim::SimError::SceneText(cause.to_string());
    let mut scene = toml::Value::try_from(shared.scene()).map_err(|cause| unwritable(&cause))?;
    let (mut files, mut outside) = (Vec::new(), Vec::new());
    take_files(&mut scene, &mut files, &mut outside)?;
    let scene = toml::to_string(&scene).map_err(|cause| unwritable(&cause))?;
    let drive: String = sim.driven().iter().map(|name| format!("{name}\n")).collect();
    let model = model(&sim, token(&scene, &drive));
    let description = model_description(version, &model, &Variables::of(&sim));
    let read = std::fs::read(library);
    let library_bytes = read
        .map_err(|cause| FmuError::File { path: library.display().to_string(), reason: cause.to_string() })?;
    let folder = match (version, std::env::consts::ARCH) {
        (Version::Two, "x86_64") => "linux64".to_owned(),
        (_, arch) => format!("{arch}-linux"),
    };
    let mut archive = Archive::default();
    let mut entries = vec![
        ("modelDescription.xml".to_owned(), description.into_bytes()),
        (format!("binaries/{folder}/{MODEL}.so"), library_bytes),
        (format!("resources/{SCENE_FILE}"), scene.into_bytes()),
        (format!("resources/{DRIVE_FILE}"), drive.into_bytes()),
    ];
    entries.extend(files.into_iter().map(|(name, content)| (format!("resources/{name}"), content)));
    let too_large = || FmuError::File { path: "the FMU".to_owned(), reason: "larger than 4 GiB".to_owned() };
    if !entries.iter().all(|(name, content)| archive.add(name, content)) {
        return Err(too_large());
    }
    Ok(Fmu { bytes: archive.finish().ok_or_else(too_large)?, outside })
}
