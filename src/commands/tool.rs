//! `trabecula tool show [FILE]`: prints a tool's dimensions, equilibria and step times.

use std::fmt::Write;
use std::path::PathBuf;

use clap::Subcommand;

use crate::failure::Failure;
use crate::say::{Figures, merged};
use crate::tool::response::{Cost, Response, Shape, Workspace, response};
use crate::tool::source::ToolSource;
use crate::tool::{Dimension, dimensions, rounded};

/// Arguments of `tool`.
#[derive(Debug, Subcommand)]
pub enum ToolCommand {
    /// Print its dimensions, its shape under each tendon, its bending modes and the step time of each model.
    Show {
        /// Scene or tool file; default: the built-in femur, whose tool is the standard one.
        file: Option<PathBuf>,
        #[command(flatten)]
        figures: Figures,
    },
}

/// Runs the command.
///
/// # Errors
/// An invalid scene or tool (2).
pub fn run(command: &ToolCommand) -> Result<(), Failure> {
    let ToolCommand::Show { file, figures } = command;
    let source = ToolSource::load(file.as_deref())?;
    let dimensions = dimensions(&source.scene)?;
    let response = response(&source.scene)?;
    figures.say(
        || format!("the tool of {source}{}", text(&dimensions, &response)),
        || {
            let dimensions = dimensions.iter().map(|it| (it.name.to_owned(), it.value.into()));
            merged(serde_json::Value::Object(dimensions.collect()), serde_json::json!(response))
        },
    );
    Ok(())
}

fn text(dimensions: &[Dimension], response: &Response) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    for it in dimensions {
        let _ = write!(text, "\n{:<18} {:>7}  {}", it.name, rounded(it.value), it.text);
    }
    let modes: Vec<String> =
        response.bending_frequencies_hz.iter().map(|hz| rounded(*hz).to_string()).collect();
    let _ = write!(text, "\nbending modes of the straight tool: {} Hz", modes.join(", "));
    let buckles_n = rounded(response.buckling_load_n);
    let _ = write!(text, "\nbuckling load, straight and clamped at the flange: {buckles_n} N at the burr");
    let slides = response.shapes.iter().any(|shape| shape.deployed_mm.is_some());
    let loads = if slides { "deployed_mm" } else { "tendon   tension_n" };
    let _ = write!(
        text,
        "\n\nequilibrium in free space; mm from the flange\n{loads}  bend_deg  toward_mm  across_mm  along_mm"
    );
    for shape in &response.shapes {
        let Shape {
            tendon,
            tension_n,
            deployed_mm,
            bend_deg,
            toward_mm,
            across_mm,
            along_mm,
            stopped,
            settled,
        } = shape;
        let tendon = tendon.map_or("none".to_owned(), |tendon| tendon.to_string());
        let load = match deployed_mm {
            Some(deployed_mm) => format!("{deployed_mm:>11}"),
            None => format!("{tendon:<8} {tension_n:>9}"),
        };
        let [bend, toward, across, along] =
            [bend_deg, toward_mm, across_mm, along_mm].map(|value| rounded(*value));
        let _ = write!(text, "\n{load}  {bend:>8}  {toward:>9}  {across:>9}  {along:>8}");
        if *stopped > 0 {
            let _ = write!(text, "  {} at their stops", foreign_text::counted(stopped, "flexure"));
        }
        if !settled {
            text.push_str("  does not settle");
        }
    }
    let Workspace { toward_mm, across_mm, along_mm, bend_deg } = &response.workspace;
    let ends = |[low, high]: &[f64; 2]| format!("{} to {}", rounded(*low), rounded(*high));
    let _ = write!(
        text,
        "\n\nreach of the burr's centre, mm: toward {}, across {}, along {}; bend {} deg\n(up to 60 N on \
         one tendon, 20 N on two, or all of an outer tube's travel and any roll)",
        ends(toward_mm),
        ends(across_mm),
        ends(along_mm),
        ends(bend_deg)
    );
    let _ = write!(text, "\n\nstep time in free space on this machine\nmodel               step_us");
    for Cost { rung, step_us, refused } in &response.costs {
        let _ = match (step_us, refused) {
            (Some(us), _) => write!(text, "\n{rung:<18}  {:>7}", rounded(*us)),
            (None, why) => write!(text, "\n{rung:<18}  unsupported: {}", why.as_deref().unwrap_or_default()),
        };
    }
    text
}
