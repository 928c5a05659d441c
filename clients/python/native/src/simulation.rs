//! One simulation.

use ::sim::{Batch, Drive, SimError, SimFactory, View};
use ipc_types::messages::layout::Message;
use ipc_types::messages::{CArmGeometry, Command, State};
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use zerocopy::{FromBytes, IntoBytes};

use crate::failing::{raised, refused};
use crate::scene::Scene;

/// A simulation on its own thread. Concurrent calls wait for each other.
#[pyclass(frozen, module = "trabecula._sim")]
pub(crate) struct Sim(Batch);

/// A simulation's state at a tick.
#[pyclass(frozen, module = "trabecula._sim")]
pub(crate) struct Snapshot(pub(crate) ::sim::Snapshot);

#[pymethods]
impl Snapshot {
    /// The state's bytes.
    fn state<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.0.state().as_bytes())
    }

    /// Scene and state as bytes.
    fn packed<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let packed = py.detach(|| self.0.packed()).map_err(|error| raised(py, &error))?;
        Ok(PyBytes::new(py, &packed))
    }

    /// Recreates a snapshot from its bytes.
    #[staticmethod]
    fn of_packed(py: Python<'_>, packed: &[u8]) -> PyResult<Snapshot> {
        py.detach(|| ::sim::Snapshot::of_packed(packed)).map(Snapshot).map_err(|error| raised(py, &error))
    }

    /// The state vector, as bytes of float64.
    fn vector<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.0.vector().as_bytes())
    }
}

/// A linear model: tick, seconds of a tick, names and units of states, inputs and outputs, the bytes of the
/// matrices and of the values, and notes.
pub(crate) type Linear<'py> =
    (u64, f64, [Vec<(String, &'static str)>; 3], [Bound<'py, PyBytes>; 8], Vec<String>);

/// Converts a linear model.
pub(crate) fn linear<'py>(py: Python<'py>, model: ::sim::LinearModel) -> Linear<'py> {
    let signals = [model.states, model.inputs, model.outputs]
        .map(|signals| signals.into_iter().map(|signal| (signal.name, signal.unit)).collect());
    let numbers = [
        &model.a,
        &model.b,
        &model.c,
        &model.d,
        &model.state,
        &model.next_state,
        &model.input,
        &model.output,
    ]
    .map(|numbers| PyBytes::new(py, numbers.as_bytes()));
    (model.tick, model.dt_s, signals, numbers, model.notes)
}

/// Returns `everything`, or the controllers with these names.
pub(crate) fn drive(everything: bool, names: Vec<String>) -> Drive {
    match (everything, names.is_empty()) {
        (true, _) => Drive::Everything,
        (false, true) => Drive::Nothing,
        (false, false) => Drive::These(names),
    }
}

/// Parses concatenated commands.
pub(crate) fn commands(py: Python<'_>, bytes: &[u8]) -> PyResult<Vec<Command>> {
    let size = Command::DESCRIPTION.size;
    if !bytes.len().is_multiple_of(size) {
        let text = format!("the commands have {} bytes, expected a multiple of {size}", bytes.len());
        return Err(refused(py, &text));
    }
    // Each chunk has the size of a command.
    Ok(bytes.chunks_exact(size).filter_map(|bytes| Command::read_from_bytes(bytes).ok()).collect())
}

/// Runs ticks while other Python threads run. A signal handler that raises, such as that of Ctrl-C, stops the
/// simulation at the tick reached.
pub(crate) fn stepped(
    py: Python<'_>,
    batch: &Batch,
    given: Option<Vec<Command>>,
    ticks: u64,
) -> PyResult<Vec<State>> {
    watched(py, |is_raised| batch.step_watched(given, ticks, is_raised))
}

/// Works while other Python threads run. The work polls whether a signal handler has raised an exception,
/// which is then the result.
fn watched<R: Send>(
    py: Python<'_>,
    work: impl FnOnce(&mut dyn FnMut() -> bool) -> Result<R, SimError> + Send,
) -> PyResult<R> {
    let mut raised_by_handler = None;
    let done = py.detach(|| {
        work(&mut || {
            if let Err(error) = Python::attach(|py| py.check_signals()) {
                raised_by_handler.get_or_insert(error);
            }
            raised_by_handler.is_some()
        })
    });
    match raised_by_handler {
        Some(error) => Err(error),
        None => done.map_err(|error| raised(py, &error)),
    }
}

/// A C-arm as passed from Python: its bytes or its angles, or neither for the scene's.
type Given = (Option<Vec<u8>>, Option<(f64, f64)>);

/// Returns the viewpoint: a C-arm given by its bytes or angles, or the scene's.
fn view_of(py: Python<'_>, geometry: Option<&[u8]>, angles_deg: Option<(f64, f64)>) -> PyResult<View> {
    match (geometry.map(CArmGeometry::read_from_bytes), angles_deg) {
        (Some(Ok(geometry)), _) => Ok(View::Geometry(geometry)),
        (Some(Err(_)), _) => Err(refused(py, "the C-arm does not have the size of a CArmGeometry")),
        (None, Some((primary_deg, secondary_deg))) => Ok(View::Angles { primary_deg, secondary_deg }),
        (None, None) => Ok(View::Scene),
    }
}

impl Sim {
    /// Works with the simulation while other Python threads run.
    fn with<R: Send + 'static>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut ::sim::Sim) -> Result<R, SimError> + Send + 'static,
    ) -> PyResult<R> {
        py.detach(|| self.0.with(0, work)).map_err(|error| raised(py, &error))
    }

    fn of(py: Python<'_>, maker: SimFactory) -> PyResult<Sim> {
        py.detach(|| Batch::of(vec![maker], 1)).map(Sim).map_err(|error| raised(py, &error))
    }
}

#[pymethods]
impl Sim {
    #[new]
    fn new(py: Python<'_>, scene: &Scene, everything: bool, names: Vec<String>) -> PyResult<Sim> {
        let (scene, drive) = (scene.0.clone(), drive(everything, names));
        Sim::of(py, Box::new(move || ::sim::Sim::new(&scene, &drive)))
    }

    /// Recreates the simulation of a log at a tick.
    #[staticmethod]
    #[pyo3(signature = (log, tick, everything, names))]
    fn from_log(
        py: Python<'_>,
        log: PathBuf,
        tick: Option<u64>,
        everything: bool,
        names: Vec<String>,
    ) -> PyResult<Sim> {
        let drive = drive(everything, names);
        let is_to_end = Arc::new(AtomicBool::new(false));
        let is_ended = Arc::clone(&is_to_end);
        let maker: SimFactory = Box::new(move || ::sim::Sim::from_log_unless(&log, tick, &drive, &is_ended));
        let made = watched(py, |is_raised| {
            Batch::of_watched(vec![maker], 1, &mut || is_to_end.store(is_raised(), Ordering::Relaxed))
        });
        made.map(Sim)
    }

    /// Runs ticks; returns the state's bytes.
    fn step<'py>(&self, py: Python<'py>, given: &[u8], ticks: u64) -> PyResult<Bound<'py, PyBytes>> {
        let given = commands(py, given)?;
        let states = stepped(py, &self.0, Some(given), ticks)?;
        Ok(PyBytes::new(py, states.as_bytes()))
    }

    /// The state's bytes.
    fn state<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let state = self.with(py, |sim| Ok(*sim.state()))?;
        Ok(PyBytes::new(py, state.as_bytes()))
    }

    /// The scene.
    fn scene(&self, py: Python<'_>) -> PyResult<Scene> {
        self.with(py, |sim| Ok(Scene(sim.shared().clone())))
    }

    /// Names of the controllers that the caller drives.
    fn driven(&self, py: Python<'_>) -> PyResult<Vec<String>> {
        self.with(py, |sim| Ok(sim.driven()))
    }

    /// Refused parts of the last commands.
    fn refusals(&self, py: Python<'_>) -> PyResult<Vec<String>> {
        self.with(py, |sim| Ok(sim.refusals().to_vec()))
    }

    /// The concatenated bytes of the readings.
    fn readings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let readings = self.with(py, |sim| Ok(sim.readings()))?;
        Ok(PyBytes::new(py, readings.as_bytes()))
    }

    /// The bytes of the tip's Jacobian.
    fn tip_jacobian<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let jacobian = self.with(py, |sim| Ok(sim.tip_jacobian()))?;
        Ok(PyBytes::new(py, jacobian.as_bytes()))
    }

    /// Indices of the drilled voxels, as bytes of uint32.
    fn drilled<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let drilled = self.with(py, |sim| Ok(sim.drilled().to_vec()))?;
        Ok(PyBytes::new(py, drilled.as_bytes()))
    }

    fn snapshot(&self, py: Python<'_>) -> PyResult<Snapshot> {
        self.with(py, |sim| Ok(Snapshot(sim.snapshot())))
    }

    fn restore(&self, py: Python<'_>, snapshot: &Snapshot) -> PyResult<()> {
        let snapshot = snapshot.0.clone();
        self.with(py, move |sim| sim.restore(&snapshot))
    }

    /// Moves to a snapshot's state with another state vector, given as bytes of float64.
    fn restore_vector(&self, py: Python<'_>, snapshot: &Snapshot, vector: &[u8]) -> PyResult<()> {
        let snapshot = snapshot.0.clone();
        // The Python half sends whole numbers of float64.
        let number = |bytes: &[u8]| bytes.try_into().map_or(f64::NAN, f64::from_le_bytes);
        let vector: Vec<f64> = vector.chunks_exact(8).map(number).collect();
        self.with(py, move |sim| sim.restore_vector(&snapshot, &vector))
    }

    /// Names and units of the state vector's entries.
    fn state_entries(&self, py: Python<'_>) -> PyResult<Vec<(String, &'static str)>> {
        let entries = self.with(py, |sim| Ok(sim.state_entries()))?;
        Ok(entries.into_iter().map(|entry| (entry.name, entry.unit)).collect())
    }

    /// The next tick with these commands as a linear model.
    fn linearize<'py>(
        &self,
        py: Python<'py>,
        given: &[u8],
        inputs: Vec<String>,
        outputs: Vec<String>,
    ) -> PyResult<Linear<'py>> {
        let given = commands(py, given)?;
        let model = self.with(py, move |sim| sim.linearize(&given, &inputs, &outputs))?;
        Ok(linear(py, model))
    }

    fn reset(&self, py: Python<'_>) -> PyResult<()> {
        self.with(py, ::sim::Sim::reset)
    }

    /// Scene and state as bytes.
    fn packed<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let packed = self.with(py, |sim| sim.packed())?;
        Ok(PyBytes::new(py, &packed))
    }

    /// Recreates a simulation from its bytes.
    #[staticmethod]
    fn of_packed(py: Python<'_>, packed: Vec<u8>) -> PyResult<Sim> {
        Sim::of(py, Box::new(move || ::sim::Sim::of_packed(&packed)))
    }

    fn branch(&self, py: Python<'_>) -> PyResult<Sim> {
        let maker = self.with(py, |sim| Ok(sim.brancher()))?;
        Sim::of(py, maker)
    }

    /// Returns the bytes of the frame and of its pixels, from a C-arm given by its bytes or angles, or the
    /// scene's.
    #[pyo3(signature = (geometry, angles_deg))]
    fn render<'py>(
        &self,
        py: Python<'py>,
        geometry: Option<&[u8]>,
        angles_deg: Option<(f64, f64)>,
    ) -> PyResult<(Bound<'py, PyBytes>, Bound<'py, PyBytes>)> {
        let view = view_of(py, geometry, angles_deg)?;
        let rendered = self.with(py, move |sim| sim.render(view))?;
        Ok((PyBytes::new(py, rendered.frame.as_bytes()), PyBytes::new(py, rendered.pixels.as_bytes())))
    }

    /// `render` for several C-arms, each given by its bytes or angles, or the scene's.
    fn render_many<'py>(
        &self,
        py: Python<'py>,
        given: Vec<Given>,
    ) -> PyResult<Vec<(Bound<'py, PyBytes>, Bound<'py, PyBytes>)>> {
        let view =
            |(geometry, angles_deg): &(Option<Vec<u8>>, _)| view_of(py, geometry.as_deref(), *angles_deg);
        let views = given.iter().map(view).collect::<PyResult<Vec<View>>>()?;
        let is_to_end = Arc::new(AtomicBool::new(false));
        let is_ended = Arc::clone(&is_to_end);
        let rendered = watched(py, |is_raised| {
            let work = move |sim: &mut ::sim::Sim| sim.render_many_unless(&views, &is_ended);
            self.0.with_watched(0, work, &mut || is_to_end.store(is_raised(), Ordering::Relaxed))
        })?;
        let bytes = |bytes: &[u8]| PyBytes::new(py, bytes);
        Ok(rendered.iter().map(|one| (bytes(one.frame.as_bytes()), bytes(one.pixels.as_bytes()))).collect())
    }

    /// `render`, followed by the labels: the mask, six float32 images concatenated in the order of
    /// `xray::Labels`, column, row, depth and visibility of each keypoint as float64, and column, row, depth
    /// and world position of each marker; then the markers' names.
    #[pyo3(signature = (geometry, angles_deg, bone_from_hu))]
    fn labels<'py>(
        &self,
        py: Python<'py>,
        geometry: Option<&[u8]>,
        angles_deg: Option<(f64, f64)>,
        bone_from_hu: Option<i16>,
    ) -> PyResult<([Bound<'py, PyBytes>; 6], Vec<String>)> {
        let view = view_of(py, geometry, angles_deg)?;
        let (rendered, labels) = self.with(py, move |sim| sim.labels(view, bone_from_hu))?;
        let images = [
            labels.anatomy,
            labels.metal,
            labels.bone_m,
            labels.tunnel_m,
            labels.tool_depth_m,
            labels.bone_depth_m,
        ];
        let places = labels
            .keypoints
            .iter()
            .map(|point| [point.column, point.row, point.depth_m, f64::from(point.visibility.code())]);
        let places: Vec<[f64; 4]> = places.collect();
        let centres = labels.markers.iter().map(|marker| {
            let ([x, y, z], point) = (marker.centre_m, &marker.point);
            [point.column, point.row, point.depth_m, x, y, z]
        });
        let centres: Vec<[f64; 6]> = centres.collect();
        let parts = [
            PyBytes::new(py, rendered.frame.as_bytes()),
            PyBytes::new(py, rendered.pixels.as_bytes()),
            PyBytes::new(py, &labels.mask),
            PyBytes::new(py, images.concat().as_bytes()),
            PyBytes::new(py, places.as_bytes()),
            PyBytes::new(py, centres.as_bytes()),
        ];
        Ok((parts, labels.markers.into_iter().map(|marker| marker.name).collect()))
    }

    fn record(&self, py: Python<'_>, folder: PathBuf) -> PyResult<()> {
        self.with(py, move |sim| sim.record(&folder))
    }

    fn close_recording(&self, py: Python<'_>) -> PyResult<bool> {
        self.with(py, ::sim::Sim::close_recording)
    }
}
