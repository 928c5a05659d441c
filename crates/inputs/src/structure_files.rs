//! Reads the label maps and meshes of a scene's `[[structure]]` and `[[drr.object]]` into the scene, so that
//! its copies in the session and in the log need no files.

use std::path::Path;

use foreign_text::foreign_path;
use ipc_types::scene::closed_mesh::ClosedMesh;
use ipc_types::scene::mesh::{MAX_MESH_BYTES, MeshFormat, Triangle, triangles};
use ipc_types::scene::{
    Label as SceneLabel, MAX_STRUCTURE_TRIANGLES, PatientFrame, Scene, SceneError, StructureLabel,
    StructureMesh, StructureSurface, StructureVoxels,
};
use ipc_types::text_file;
use volume_io::{Label, ReadOptions};

/// Bytes at the start of a mesh file in which 3D Slicer states the patient frame.
const HEAD_BYTES: usize = 1024;

/// Reads the files of a scene's structures and X-ray objects, except those whose content the scene already
/// holds; `file` is the scene's, for errors.
///
/// # Errors
/// [`SceneError::Invalid`] for the first file that is refused.
pub fn put_in(scene: &mut Scene, file: &Path) -> Result<(), SceneError> {
    let refuse =
        |(key, problem): (String, String)| SceneError::Invalid { file: file.to_owned(), key, problem };
    for structure in &mut scene.structure {
        let key = |of: &str| format!("structure `{}`.{of}", structure.name);
        if let Some(label) = structure.label.as_mut().filter(|label| label.voxels.is_none()) {
            label.voxels = Some(voxels(label).map_err(|problem| refuse((key("label"), problem)))?);
        }
        if let Some(mesh) = structure.mesh.as_mut().filter(|mesh| mesh.surface.is_none()) {
            mesh.surface = Some(surface(mesh, None).map_err(|problem| refuse((key("mesh"), problem)))?);
        }
    }
    for object in scene.drr.iter_mut().flat_map(|drr| &mut drr.object) {
        if let Some(mesh) = object.mesh.as_mut().filter(|mesh| mesh.surface.is_none()) {
            let key = format!("drr.object `{}`.mesh", object.name);
            let read = surface(mesh, Some(PatientFrame::Lps));
            mesh.surface = Some(read.map_err(|problem| refuse((key, problem)))?);
        }
    }
    scene.check_structure_content().map_err(refuse)
}

/// Reads the part of a label map that holds a label.
fn voxels(of: &StructureLabel) -> Result<StructureVoxels, String> {
    let label = match &of.label {
        SceneLabel::Value(value) => Label::Value(*value),
        SceneLabel::Name(name) => Label::Name(name.clone()),
    };
    let options = ReadOptions { label: Some(label), ..ReadOptions::default() };
    let (volume, _) = volume_io::read_as(&of.file, &options).map_err(|cause| cause.to_string())?;
    let grid = &volume.grid;
    let (mut low, mut high) = (grid.dims(), [0; 3]);
    let inside = volume.hu.iter().enumerate().filter(|(_, value)| **value != 0);
    for voxel in inside.filter_map(|(index, _)| grid.voxel(index)) {
        for axis in 0..3 {
            low[axis] = low[axis].min(voxel[axis]);
            high[axis] = high[axis].max(voxel[axis] + 1);
        }
    }
    if high == [0; 3] {
        return Err(format!("names {}, in which no voxel has this label", foreign_path(&of.file)));
    }
    let dims = [0, 1, 2].map(|axis| high[axis] - low[axis]);
    let origin_mm = grid.world_m(low.map(|index| index as f64)).map(|x| x * 1e3);
    let (ni, nj) = (grid.dims()[0], grid.dims()[1]);
    let rows = (low[2]..high[2]).flat_map(|k| (low[1]..high[1]).map(move |j| ni * (j + nj * k)));
    let is_inside =
        rows.flat_map(|row| volume.hu[row + low[0]..row + high[0]].iter().map(|value| *value != 0));
    Ok(StructureVoxels::pack(dims, grid.spacing_m().map(|x| x * 1e3), origin_mm, grid.axes(), is_inside))
}

/// Reads a closed mesh. `unstated` is the frame of a file that states none.
fn surface(of: &StructureMesh, unstated: Option<PatientFrame>) -> Result<StructureSurface, String> {
    read_surface(of, unstated).map_err(|problem| format!("names {}, which {problem}", foreign_path(&of.file)))
}

fn read_surface(of: &StructureMesh, unstated: Option<PatientFrame>) -> Result<StructureSurface, String> {
    let format = MeshFormat::of(&of.file).ok_or("is not an STL or OBJ file")?;
    let content = text_file::read_bytes(&of.file, MAX_MESH_BYTES)
        .map_err(|cause| format!("cannot be read ({cause})"))?;
    let frame = match (of.frame, stated_frame(&content)) {
        (None, None) if unstated.is_none() => {
            return Err("does not state its patient frame; set `frame` to \"lps\" or \"ras\"".to_owned());
        }
        (Some(given), Some(stated)) if given != stated => {
            return Err(format!("states {stated:?}, but `frame` is {given:?}; remove `frame`"));
        }
        (given, stated) => given.or(stated).or(unstated),
    };
    let mut triangles =
        triangles(&content, format, MAX_STRUCTURE_TRIANGLES).map_err(|cause| cause.to_string())?;
    if frame == Some(PatientFrame::Ras) {
        triangles.iter_mut().for_each(to_lps);
    }
    Ok(StructureSurface::pack(&ClosedMesh::new(&triangles).map_err(|fault| fault.to_string())?))
}

/// Turns a triangle from RAS to LPS, which is half a turn about z.
fn to_lps(triangle: &mut Triangle) {
    for corner in triangle {
        *corner = [0.0 - corner[0], 0.0 - corner[1], corner[2]];
    }
}

/// The patient frame that 3D Slicer writes into the header or first comment of a mesh file.
fn stated_frame(content: &[u8]) -> Option<PatientFrame> {
    let head = &content[..content.len().min(HEAD_BYTES)];
    let states = |words: &[u8]| head.windows(words.len()).any(|bytes| bytes == words);
    match (states(b"SPACE=LPS"), states(b"SPACE=RAS")) {
        (true, false) => Some(PatientFrame::Lps),
        (false, true) => Some(PatientFrame::Ras),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCENE: &str = "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\nburr_start_mm = \
                         [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n";

    /// A folder with a scene with one structure of this shape, and files beside it.
    struct Place(tempfile::TempDir);

    impl Place {
        fn with(files: &[(&str, &[u8])]) -> Place {
            let folder = tempfile::tempdir().unwrap();
            for (name, content) in files {
                std::fs::write(folder.path().join(name), content).unwrap();
            }
            Place(folder)
        }

        fn load(&self, shape: &str) -> Result<Scene, String> {
            let file = self.0.path().join("scene.toml");
            std::fs::write(&file, format!("{SCENE}[[structure]]\nname = \"nerve\"\n{shape}\n")).unwrap();
            crate::scenes::load(&file).map_err(|refused| refused.to_string())
        }
    }

    /// A segmentation of 3 x 2 x 1 voxels of 2 mm with two segments, RAS.
    fn segmentation() -> Vec<u8> {
        let header = "NRRD0004\ntype: unsigned char\ndimension: 3\nspace: right-anterior-superior\nsizes: 3 2 1\n\
                      space directions: (2,0,0) (0,2,0) (0,0,2)\nspace origin: (-5,1,7)\nencoding: raw\n\
                      Segment0_Name:=femur\nSegment0_LabelValue:=1\nSegment0_Layer:=0\nSegment1_Name:=nerve\n\
                      Segment1_LabelValue:=2\nSegment1_Layer:=0\n\n";
        [header.as_bytes(), &[1, 2, 2, 1, 0, 2]].concat()
    }

    #[test]
    fn a_segment_and_a_label_become_the_voxels_of_their_box_and_stay_in_copies_of_the_scene() {
        let place = Place::with(&[("s.seg.nrrd", &segmentation())]);
        for label in ["\"nerve\"", "2"] {
            let scene = place.load(&format!("label = {{ file = \"s.seg.nrrd\", label = {label} }}")).unwrap();
            let voxels = scene.structure[0].label.as_ref().unwrap().voxels.as_ref().unwrap();
            assert_eq!(
                (voxels.dims, voxels.is_inside().unwrap()),
                ([2, 2, 1], vec![true, true, false, true])
            );
            // The second voxel of the first row: -5 + 2 in RAS.
            let far = |a: &f64, b: &f64| (a - b).abs() > 1e-9;
            assert!(!voxels.origin_mm.iter().zip(&[3.0, -1.0, 7.0]).any(|(a, b)| far(a, b)), "{voxels:?}");
            let copy = toml::to_string(&scene).unwrap();
            assert_eq!(Scene::parse(&copy, Path::new("elsewhere/a.toml")).unwrap(), scene);
        }
        for (label, problem) in [("\"vein\"", "label \"vein\" not found"), ("7", "label 7 not found")] {
            let refused =
                place.load(&format!("label = {{ file = \"s.seg.nrrd\", label = {label} }}")).unwrap_err();
            assert!(refused.contains("structure `nerve`.label") && refused.contains(problem), "{refused}");
        }
    }

    /// A tetrahedron as an OBJ file with a first line.
    fn tetrahedron(first: &str, faces: usize) -> Vec<u8> {
        let corners = "v 0 0 0\nv 10 0 0\nv 0 20 0\nv 0 0 30\n";
        let all = ["f 1 3 2\n", "f 1 2 4\n", "f 2 3 4\n", "f 3 1 4\n"];
        format!("{first}\n{corners}{}", all[..faces].concat()).into_bytes()
    }

    #[test]
    fn a_mesh_is_placed_by_the_frame_that_its_file_states() {
        let ras = tetrahedron("# 3D Slicer output. SPACE=RAS", 4);
        let files: [(&str, &[u8]); 4] = [
            ("ras.obj", &ras),
            ("bare.obj", &tetrahedron("# from elsewhere", 4)),
            ("open.obj", &tetrahedron("# SPACE=LPS", 3)),
            ("a.ply", b"ply"),
        ];
        let place = Place::with(&files);
        let bounds = |shape: &str| {
            let scene = place.load(shape).unwrap();
            let mesh = scene.structure[0].mesh.as_ref().unwrap().surface.as_ref().unwrap().mesh().unwrap();
            assert!((mesh.volume() - 1000.0).abs() < 1e-9);
            mesh.bounds()
        };
        assert_eq!(bounds("mesh = { file = \"ras.obj\" }"), [[-10.0, -20.0, 0.0], [0.0, 0.0, 30.0]]);
        assert_eq!(
            bounds("mesh = { file = \"bare.obj\", frame = \"lps\" }"),
            [[0.0, 0.0, 0.0], [10.0, 20.0, 30.0]]
        );
        for (shape, problem) in [
            ("mesh = { file = \"bare.obj\" }", "does not state its patient frame"),
            ("mesh = { file = \"ras.obj\", frame = \"lps\" }", "states Ras, but `frame` is Lps"),
            ("mesh = { file = \"open.obj\" }", "is not closed: 3 edges"),
            ("mesh = { file = \"a.ply\" }", "is not an STL or OBJ file"),
            ("mesh = { file = \"none.stl\" }", "cannot be read"),
        ] {
            let refused = place.load(shape).unwrap_err();
            assert!(refused.contains("structure `nerve`.mesh") && refused.contains(problem), "{refused}");
        }
    }

    #[test]
    fn a_mesh_of_an_x_ray_object_is_taken_as_it_is_unless_its_file_states_a_frame() {
        let files: [(&str, &[u8]); 3] = [
            ("ras.obj", &tetrahedron("# 3D Slicer output. SPACE=RAS", 4)),
            ("bare.obj", &tetrahedron("# from elsewhere", 4)),
            ("open.obj", &tetrahedron("# from elsewhere", 3)),
        ];
        let place = Place::with(&files);
        let load = |name: &str| {
            place.load(&format!(
                "ball = {{ centre_mm = [0.0, 0.0, 0.0], radius_mm = 1.0 }}\n[volume]\n\
                 phantom = \"block\"\n[drr]\n\
                 rate_hz = 0.0\nisocentre_mm = [0.0, 0.0, 0.0]\ncolumns = 16\nrows = 16\n\
                 pixel_pitch_mm = 1.0\n\
                 [[drr.object]]\nname = \"screw\"\nmaterial = \"titanium\"\nmesh = {{ file = \"{name}\" }}"
            ))
        };
        for (name, far) in [("ras.obj", [0.0, 0.0, 30.0]), ("bare.obj", [10.0, 20.0, 30.0])] {
            let scene = load(name).unwrap();
            let mesh = scene.drr.as_ref().unwrap().object[0].mesh.as_ref().unwrap();
            assert_eq!(mesh.surface.as_ref().unwrap().mesh().unwrap().bounds()[1], far, "{name}");
            let copy = toml::to_string(&scene).unwrap();
            assert_eq!(Scene::parse(&copy, Path::new("elsewhere/a.toml")).unwrap(), scene);
        }
        let refused = load("open.obj").unwrap_err();
        assert!(
            refused.contains("drr.object `screw`.mesh") && refused.contains("is not closed"),
            "{refused}"
        );
    }

    #[test]
    fn a_curve_becomes_a_tube_and_a_closed_one_ends_where_it_begins() {
        let curve = |kind: &str| {
            format!(
                "{{\"markups\": [{{\"type\": \"{kind}\", \"coordinateSystem\": \"RAS\", \"controlPoints\": [\
                 {{\"position\": [1, 2, 3]}}, {{\"position\": [4, 5, 6]}}, {{\"position\": [4, 0, 6]}}]}}]}}"
            )
        };
        let [open, closed, points] = ["Curve", "ClosedCurve", "Fiducial"].map(curve);
        let files: [(&str, &[u8]); 3] = [
            ("open.mrk.json", open.as_bytes()),
            ("closed.mrk.json", closed.as_bytes()),
            ("points.mrk.json", points.as_bytes()),
        ];
        let place = Place::with(&files);
        let shape = |name: &str| format!("curve = {{ file = \"{name}.mrk.json\", radius_mm = 1.5 }}");
        let tube = |name: &str| place.load(&shape(name)).unwrap().structure[0].tube.clone().unwrap();
        let three = [[-1.0, -2.0, 3.0], [-4.0, -5.0, 6.0], [-4.0, 0.0, 6.0]];
        assert_eq!((tube("open").points_mm, tube("open").radius_mm), (three.to_vec(), 1.5));
        assert_eq!(tube("closed").points_mm, [&three[..], &three[..1]].concat());
        let both = format!("{}\ntube = {{ points_mm = [[0.0, 0.0, 0.0]], radius_mm = 1.0 }}", shape("open"));
        for (shape, problem) in
            [(shape("points"), "is not a line, curve or closed curve"), (both, "mutually exclusive")]
        {
            let refused = place.load(&shape).unwrap_err();
            assert!(refused.contains(problem), "{refused}");
        }
    }
}
