//! Parameter sweeps: which scenes to run, and how their results depend on the parameters.
//!
//! A [`Study`] is a TOML file with a scene, the parameters to vary, and a design. [`Study::point`] returns
//! the settings of run i; [`indices`] and [`spearman`] compute which parameters a result depends on.
//!
//! **Boundary:** text and numbers in, values out; files and runs are up to `trabecula sweep`
//! (`src/sweep/`). **Invariant:** point i depends only on the study's text and on i, so points can be
//! run anywhere and in any order.
//!
//! ```
//! let text = r#"
//! design = "sobol"
//! samples = 8
//! [[parameter]]
//! key = "drilling.edge_pressure_mpa"
//! min = 0.0
//! max = 2.0
//! [[parameter]]
//! key = "manipulator.model"
//! values = ["planar", "spatial"]
//! "#;
//! let study = sweep::Study::parse(text, std::path::Path::new("sweep.toml"), None).unwrap();
//! assert_eq!(study.count(), 8);
//! let settings = study.point(3).settings();
//! assert!(settings[0].starts_with("drilling.edge_pressure_mpa="), "{settings:?}");
//! ```
//!
//! | module | contents |
//! |---|---|
//! | [`Study`], [`Point`], [`StudyError`] | the validated file; its points |
//! | [`Design`] | distribution of the points: grid, random, Latin hypercube, Sobol, Saltelli, table |
//! | `sensitivity` | Sobol indices of a Saltelli design, rank correlations of any other |
//! | [`pareto_front`], [`sobol_point`] | for a search: the best points of two objectives, points to try |
//! | [`Proportion`] | a share of runs with its interval |

mod design;
mod error;
mod front;
mod parameter;
mod proportion;
mod sensitivity;
mod study;
mod table;

pub use design::{Design, MAX_SOBOL_SAMPLES, sobol_point};
pub use error::StudyError;
pub use front::{pareto_front, pareto_order};
pub use parameter::{MAX_VALUES, Parameter, Scale};
pub use proportion::Proportion;
pub use sensitivity::{Index, indices, spearman};
pub use study::{MAX_PARAMETERS, MAX_POINTS, Point, Record, Study};
