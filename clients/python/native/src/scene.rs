//! A checked scene with its volume.

use std::path::PathBuf;
use std::sync::Arc;

use ::sim::SharedScene;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use zerocopy::IntoBytes;

use crate::failing::raised;

/// A checked scene with its volume, shared by simulations.
#[pyclass(frozen, module = "trabecula._sim")]
pub(crate) struct Scene(pub(crate) Arc<SharedScene>);

#[pymethods]
impl Scene {
    /// Reads and checks a scene.
    #[staticmethod]
    #[pyo3(signature = (file, settings, seed, beside))]
    fn load(
        py: Python<'_>,
        file: Option<PathBuf>,
        settings: Vec<String>,
        seed: Option<u64>,
        beside: Option<&Scene>,
    ) -> PyResult<Scene> {
        let beside = beside.map(|scene| Arc::clone(&scene.0));
        let loaded = py
            .detach(|| SharedScene::load_beside(beside.as_deref(), file.as_deref(), &settings, seed))
            .map_err(|error| raised(py, &error))?;
        Ok(Scene(loaded))
    }

    /// The scene as TOML.
    fn toml(&self, py: Python<'_>) -> PyResult<String> {
        self.0.toml().map_err(|error| raised(py, &error))
    }

    /// Notes on scene and volume.
    fn notes(&self) -> Vec<String> {
        self.0.notes().to_vec()
    }

    /// Returns name of the scene, tick in seconds, number of ticks of a complete run, and seed.
    fn facts(&self) -> (String, f64, u64, u64) {
        let scene = self.0.scene();
        (scene.name.clone(), scene.dt_s(), scene.tick_count(), scene.run.seed)
    }

    /// Names of the controllers.
    fn controllers(&self) -> Vec<String> {
        self.0.scene().controller_names()
    }

    /// Returns header and Hounsfield units of the volume, or `None` without one.
    fn volume<'py>(&self, py: Python<'py>) -> Option<(Bound<'py, PyBytes>, Bound<'py, PyBytes>)> {
        let header = self.0.volume()?;
        Some((PyBytes::new(py, header.as_bytes()), PyBytes::new(py, self.0.hu().as_bytes())))
    }
}
