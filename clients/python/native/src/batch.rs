//! Batches of simulations.

use ::sim::SimError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use zerocopy::IntoBytes;

use crate::failing::raised;
use crate::scene::Scene;
use crate::simulation::{Linear, Snapshot, commands, drive, linear, stepped};

/// Simulations that are stepped together.
#[pyclass(frozen, module = "trabecula._sim")]
pub(crate) struct Batch(::sim::Batch);

impl Batch {
    /// Works with the simulations while other Python threads run.
    fn with<R: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&::sim::Batch) -> Result<R, SimError> + Send,
    ) -> PyResult<R> {
        py.detach(|| work(&self.0)).map_err(|error| raised(py, &error))
    }
}

#[pymethods]
impl Batch {
    #[new]
    fn new(
        py: Python<'_>,
        scenes: Vec<PyRef<'_, Scene>>,
        threads: usize,
        everything: bool,
        names: Vec<String>,
    ) -> PyResult<Batch> {
        let scenes: Vec<_> = scenes.iter().map(|scene| scene.0.clone()).collect();
        let batch = py.detach(|| ::sim::Batch::new(&scenes, &drive(everything, names), threads));
        batch.map(Batch).map_err(|error| raised(py, &error))
    }

    /// Runs ticks in every simulation; returns the concatenated bytes of all states.
    #[pyo3(signature = (given, ticks))]
    fn step<'py>(&self, py: Python<'py>, given: Option<&[u8]>, ticks: u64) -> PyResult<Bound<'py, PyBytes>> {
        let given = given.map(|bytes| commands(py, bytes)).transpose()?;
        let states = stepped(py, &self.0, given, ticks)?;
        Ok(PyBytes::new(py, states.as_bytes()))
    }

    /// The next tick of every simulation as a linear model.
    #[pyo3(signature = (given, inputs, outputs))]
    fn linearize<'py>(
        &self,
        py: Python<'py>,
        given: Option<&[u8]>,
        inputs: Vec<String>,
        outputs: Vec<String>,
    ) -> PyResult<Vec<Linear<'py>>> {
        let given = given.map(|bytes| commands(py, bytes)).transpose()?;
        let models = self.with(py, |batch| batch.linearize_watched(given, &inputs, &outputs, &mut || ()))?;
        Ok(models.into_iter().map(|model| linear(py, model)).collect())
    }

    /// The concatenated bytes of all states.
    fn states<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let states = self.with(py, ::sim::Batch::states)?;
        Ok(PyBytes::new(py, states.as_bytes()))
    }

    fn driven(&self) -> Vec<String> {
        self.0.driven().to_vec()
    }

    fn threads(&self) -> usize {
        self.0.threads()
    }

    /// A snapshot of one simulation.
    fn snapshot(&self, py: Python<'_>, index: usize) -> PyResult<Snapshot> {
        self.with(py, |batch| batch.with(index, |sim| Ok(sim.snapshot()))).map(Snapshot)
    }

    fn restore(&self, py: Python<'_>, snapshots: Vec<PyRef<'_, Snapshot>>) -> PyResult<()> {
        let snapshots: Vec<_> = snapshots.iter().map(|snapshot| snapshot.0.clone()).collect();
        self.with(py, |batch| batch.restore(snapshots))
    }

    fn reset(&self, py: Python<'_>, which: Vec<bool>) -> PyResult<()> {
        self.with(py, |batch| batch.reset(which))
    }

    /// Indices of the voxels drilled by one simulation, as bytes of uint32.
    fn drilled<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyBytes>> {
        let drilled = self.with(py, |batch| batch.with(index, |sim| Ok(sim.drilled().to_vec())))?;
        Ok(PyBytes::new(py, drilled.as_bytes()))
    }
}
