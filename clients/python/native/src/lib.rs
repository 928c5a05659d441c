//! The native half of the Python module `trabecula.sim`: simulations as Python objects, messages as bytes.
//!
//! The Python half (`clients/python/trabecula/sim.py`) adds names, types and documentation. Everything passed
//! to Python is a copy in Python's own memory, so no view can dangle or change; a state has 7 kB, a tenth of
//! a percent of a tick. **Invariants:** no `unsafe` (pyo3's macros contain what Python's C interface needs);
//! the interpreter lock is released while a simulation works.

mod batch;
mod failing;
mod identification;
mod scene;
mod simulation;

use pyo3::prelude::*;

/// The module `trabecula._sim`.
#[pymodule]
fn _sim(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<scene::Scene>()?;
    module.add_class::<simulation::Sim>()?;
    module.add_class::<simulation::Snapshot>()?;
    module.add_class::<batch::Batch>()?;
    module.add_function(wrap_pyfunction!(identification::identify, module)?)?;
    Ok(())
}
