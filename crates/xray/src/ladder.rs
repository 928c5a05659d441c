//! Selects the fastest projector within a tolerance, among those with a measured error.
//!
//! For each projector, `rungs.csv` holds the largest error of three poses (0/0, 37/18, 90/5 degrees),
//! relative r.m.s., against Siddon's sum in f64 at every eighth pixel of 512 x 512 in both directions, and
//! the median frame time. The volume is the thigh of [`reference`](crate::reference) in 512 x 512 x 400
//! voxels of 0.5 mm. `trabecula-lab chart drr --rungs FILE` writes the file.

use crate::renderer::Projector;

const RUNGS: &str = include_str!("rungs.csv");

/// A projector and its measured error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rung {
    /// The projector.
    pub projector: Projector,
    /// Largest error of three poses against Siddon's sum, relative r.m.s.
    pub error_rel: f64,
    /// Milliseconds per frame of 512 x 512 pixels on the machine that produced the table; only the order
    /// matters.
    pub frame_ms: f64,
}

/// The rungs, fastest first.
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

/// The line of a projector in `rungs.csv`; `None` if it is not a rung.
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

/// The fastest rung with a measured error of at most `wanted_rel`; otherwise Siddon's sum, the reference.
pub fn choose(wanted_rel: f64) -> Rung {
    let siddon = Rung { projector: Projector::Siddon, error_rel: 0.0, frame_ms: f64::INFINITY };
    rungs().into_iter().find(|rung| rung.error_rel <= wanted_rel).unwrap_or(siddon)
}
