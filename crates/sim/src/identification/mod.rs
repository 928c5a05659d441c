//! Identification: parameters of scenes from measured files, in this process.
//!
//! [`OpenedStudy::open`] reads a study with its scenes and files; then [`OpenedStudy::identify`] fits it,
//! [`OpenedStudy::check`] compares once without fitting, [`OpenedStudy::plan`] ranks candidate experiments,
//! and [`OpenedStudy::simulate`] gives synthetic measurements. Every simulation is one of
//! [`Sim`](crate::Sim); those of a request run at once on all cores, and their number changes no bit.

mod fit;
mod model;
mod open;
mod predict;
mod result;
mod run;
mod synthetic;

pub use fit::STANDARD_MARGIN;
pub use open::OpenedStudy;
pub use predict::Band;
pub use result::{
    CandidateReport, CheckReport, ColumnReport, DesignReport, ExperimentReport, FitReport, MeasuredReport,
    ParameterReport, Series,
};
pub use synthetic::SyntheticFile;

/// Asked every few ticks whether the caller wants to end.
pub type IsToEnd<'a> = &'a (dyn Fn() -> bool + Sync);
