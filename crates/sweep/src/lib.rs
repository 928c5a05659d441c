//! Parameter sweeps: which scenes to run, and what their results say about the parameters.
//!
//! A [`Study`] is a file of TOML: a scene, the parameters to vary, and a design. [`Study::point`] gives the
//! settings of its run number i; [`indices`] and [`spearman`] say afterwards which parameters a result
//! depends on.
//!
//! **Boundary:** text and numbers in, values out: it opens no file and runs nothing; `trabecula sweep` does
//! (`src/sweep/`). **Invariant:** point i is a function of the study's text and of i alone, so points can be
//! made anywhere and in any order.
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
//! | module | what it holds |
//! |---|---|
//! | [`Study`], [`Point`], [`StudyError`] | the file, checked; its points |
//! | [`Design`] | how the points lie: grid, random, Latin hypercube, Sobol, Saltelli, a table |
//! | `sensitivity` | Sobol indices of a Saltelli design, rank correlations of any other |

mod design;
mod error;
mod parameter;
mod sensitivity;
mod study;
mod table;

pub use design::{Design, MAX_SOBOL_SAMPLES};
pub use error::StudyError;
pub use parameter::{MAX_VALUES, Parameter, Scale};
pub use sensitivity::{Index, indices, spearman};
pub use study::{MAX_PARAMETERS, MAX_POINTS, Point, Record, Study};
