//! FMUs of others: the archive and its model description, before anything of them runs.

use std::path::{Component, Path};

use trabecula_fmu::Archive;
use trabecula_fmu::master::Archived;

/// Longest content that is unpacked here: the seeds are small, and an archive of megabytes only takes time.
const MOST_BYTES: usize = 1 << 20;

/// Reads an FMU. The names of an accepted one stay in the folder into which it is extracted; each file is
/// whole or refused.
pub fn fmu(data: &[u8]) {
    let Ok(archived) = Archived::of(data.to_vec()) else { return };
    let model = &archived.model;
    assert!(model.identifier.chars().all(|c| c.is_ascii_alphanumeric() || c == '_'));
    assert!(model.variables.iter().all(|variable| model.variable(&variable.name).is_some()));
    if data.len() > MOST_BYTES {
        return;
    }
    for (name, content) in archived.files() {
        let parts: Vec<Component> = Path::new(name).components().collect();
        assert!(parts.iter().all(|part| matches!(part, Component::Normal(_))), "{name:?}");
        // Deflate expands at most 1032 times.
        assert!(content.is_err() || content.is_ok_and(|content| content.len() <= 1032 * data.len()));
    }
}

/// Seeds: an FMU of each version.
pub fn seeds() -> Vec<Vec<u8>> {
    let head = |version: &str, token: &str| {
        format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<fmiModelDescription fmiVersion=\"{version}\" modelName=\"m\" \
             {token}=\"t\"><CoSimulation modelIdentifier=\"m\"/><DefaultExperiment stepSize=\"1e-3\"/>\
             <ModelVariables>"
        )
    };
    let three = head("3.0", "instantiationToken")
        + "<Float64 name=\"u\" valueReference=\"1\" causality=\"input\" start=\"0\"/><UInt32 name=\"n\" \
           valueReference=\"2\" causality=\"output\"><Dimension start=\"3\"/></UInt32></ModelVariables></fmiModelDescription>";
    let two = head("2.0", "guid")
        + "<ScalarVariable name=\"u\" valueReference=\"1\" causality=\"input\"><Real start=\"0\"/></ScalarVariable>\
           </ModelVariables></fmiModelDescription>";
    let own = format!("{}-linux", std::env::consts::ARCH);
    let folders = [("linux64", two), (own.as_str(), three)];
    let archive = |(folder, description): &(&str, String)| {
        let mut archive = Archive::default();
        assert!(archive.add("modelDescription.xml", description.as_bytes()));
        assert!(archive.add(&format!("binaries/{folder}/m.so"), b"library"));
        assert!(archive.add("resources/a/b.txt", &[b'x'; 300]));
        archive.finish().unwrap()
    };
    folders.iter().map(archive).collect()
}
