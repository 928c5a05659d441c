//! The fastest projector for a tolerance, among those whose error was measured.
//!
//! `rungs.csv` holds, for each projector, the largest error of three poses (0/0, 37/18, 90/5 degrees), relative and r.m.s., against
//! Siddon's sum in f64 on every eighth pixel of 512 x 512 in both directions, for the thigh of [`reference`](crate::reference) in
//! 512 x 512 x 400 voxels of 0.5 mm; and the median frame time. `trabecula chart drr --rungs FILE` writes it.

use crate::renderer::Projector;

const RUNGS: &str = include_str!("rungs.csv");

/// A projector with its measured error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rung {
    /// The projector.
    pub projector: Projector,
    /// Largest error of three poses against Siddon's sum, relative, r.m.s.
    pub error_rel: f64,
    /// Milliseconds for a frame of 512 x 512 pixels on the machine that made the table: only the order matters.
    pub frame_ms: f64,
}

/// The rungs, the fastest first.
pub fn rungs() -> Vec<Rung> {
    let mut rungs: Vec<Rung> = RUNGS.lines().filter_map(rung).collect();
    rungs.sort_by(|a, b| a.frame_ms.total_cmp(&b.frame_ms));
    rungs
}

/// A line `projector,parameter,error_rel,frame_ms`; `None` for the header.
fn rung(line: &str) -> Option<Rung> {
    let fields: Vec<&str> = line.split(',').collect();
    let &[name, parameter, error_rel, frame_ms] = fields.as_slice() else { return None };
    let parameter: f64 = parameter.parse().ok()?;
    let projector = match name {
        "siddon" => Projector::Siddon,
        "joseph" => Projector::Joseph,
        "slice_ordered" => Projector::SliceOrdered { oversampling: parameter, sharpen: true },
        "preview" => Projector::Preview { reduction: parameter as u32 },
        _ => return None,
    };
    Some(Rung { projector, error_rel: error_rel.parse().ok()?, frame_ms: frame_ms.parse().ok()? })
}

/// The line of a projector in `rungs.csv`; `None` for one that is not a rung.
pub fn line_of(projector: Projector, error_rel: f64, frame_ms: f64) -> Option<String> {
    let (name, parameter) = match projector {
        Projector::Siddon => ("siddon", 0.0),
        Projector::Joseph => ("joseph", 0.0),
        Projector::SliceOrdered { oversampling, sharpen: true } => ("slice_ordered", oversampling),
        Projector::SliceOrdered { sharpen: false, .. } => return None,
        Projector::Preview { reduction } => ("preview", f64::from(reduction)),
    };
    Some(format!("{name},{parameter},{error_rel:.3e},{frame_ms:.3}"))
}

/// The fastest rung whose measured error is at most `wanted_rel`; if there is none, Siddon's sum, the reference.
pub fn choose(wanted_rel: f64) -> Rung {
    let siddon = Rung { projector: Projector::Siddon, error_rel: 0.0, frame_ms: f64::INFINITY };
    rungs().into_iter().find(|rung| rung.error_rel <= wanted_rel).unwrap_or(siddon)
}
