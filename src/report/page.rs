//! `report.html`: the whole report as one self-contained page. Any text in it can be untrusted (a scene's
//! name, a controller's warning), so the template escapes all of them.

use askama::Template;
use data_encoding::BASE64;

use super::summary::Summary;

/// A picture embedded in the page.
#[derive(Debug)]
pub struct Picture {
    caption: &'static str,
    data_uri: String,
}

impl Picture {
    /// Embeds a PNG file.
    pub fn png(caption: &'static str, bytes: &[u8]) -> Picture {
        Picture { caption, data_uri: format!("data:image/png;base64,{}", BASE64.encode(bytes)) }
    }

    /// Embeds an SVG file. As an image it runs no scripts and loads nothing.
    pub fn svg(caption: &'static str, bytes: &[u8]) -> Picture {
        Picture { caption, data_uri: format!("data:image/svg+xml;base64,{}", BASE64.encode(bytes)) }
    }
}

#[derive(Template)]
#[template(path = "report.html")]
struct Page<'a> {
    title: String,
    outcome: &'a str,
    version: &'static str,
    warnings: Vec<&'a str>,
    table: String,
    frames: &'a [Picture],
    figures: &'a [Picture],
    replay_command: &'a str,
    scene: &'a str,
}

/// Renders the page of a run; `scene` is its scene as TOML.
pub fn page(
    summary: &Summary,
    scene: &str,
    frames: &[Picture],
    figures: &[Picture],
) -> Result<String, askama::Error> {
    let warnings = summary.warnings.iter().chain(&summary.logs.notes).map(String::as_str).collect();
    let page = Page {
        title: format!("Run of {}", summary.scene.as_deref().unwrap_or("an unknown scene")),
        outcome: &summary.outcome,
        version: env!("CARGO_PKG_VERSION"),
        warnings,
        table: summary.to_string(),
        frames,
        figures,
        replay_command: &summary.replay_command,
        scene,
    };
    page.render()
}
