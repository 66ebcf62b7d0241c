//! Motion as binary glTF 2.0: bodies that show where their front and their head point, moved by one
//! animation. Source: glTF 2.0 Specification, Khronos Group, ISO/IEC 12113:2022.
//!
//! glTF has our axes and units, right-handed, +Y up, +Z forward, metres, seconds; only the order of
//! a quaternion's components differs.

use std::io::{self, Write};

use ndarray::{ArrayView2, ArrayView3};
use serde_json::{Map, Value, json};

use super::body::{Corner, body};
use super::{PoseError, poses};
use crate::motion::group::DANCER_COLORS;
use crate::motion::kinematics::Poses;
use crate::motion::quaternion::Quaternion;
use crate::units::{FPS, frames_to_s};

const MAGIC: &[u8; 4] = b"glTF";
const VERSION: u32 = 2;
const HEADER_BYTES: usize = 12;
const CHUNK_HEADER_BYTES: usize = 8;
/// Chunks and what they hold begin at multiples of this.
const ALIGNMENT_BYTES: usize = 4;

/// Accessor component type: 32-bit floats.
const FLOAT: u32 = 5126;
/// Buffer view target: attributes of vertices.
const ARRAY_BUFFER: u32 = 34962;
/// Primitive mode: each three vertices are a triangle.
const TRIANGLES: u32 = 4;

/// Writes position and orientation of motion, `[T, 25]`, `T >= 1`, as the animation of a node `body`;
/// `audio`, the name of the music's file, is noted in the `extras`.
///
/// Frame t is at `t / FPS` s; players interpolate linearly, and spherically between orientations.
///
/// # Errors
/// The error of `out`, [`super::PoseError`] for what glTF cannot hold, and more than 4 GiB.
///
/// # Panics
/// When there are other than 25 channels.
pub fn write_glb(
    frames: ArrayView2<'_, f32>,
    audio: Option<&str>,
    out: &mut dyn Write,
) -> io::Result<()> {
    let body =
        Figure { name: "body".to_owned(), color: [0.8, 0.45, 0.2], poses: poses(frames, "glTF")? };
    write(&[body], audio, out)
}

/// Writes a group, `[N, T, 25]`, `N >= 1` and `T >= 1`, as one animation of the nodes `dancer_0` to
/// `dancer_{N - 1}`, each in its colour; else as [`write_glb`].
///
/// # Errors
/// The error of `out`, [`super::PoseError`] for what glTF cannot hold, and more than 4 GiB.
///
/// # Panics
/// When there are other than 25 channels.
pub fn write_group_glb(
    group: ArrayView3<'_, f32>,
    audio: Option<&str>,
    out: &mut dyn Write,
) -> io::Result<()> {
    let figure = |(i, frames): (usize, ArrayView2<'_, f32>)| {
        let color = DANCER_COLORS[i % DANCER_COLORS.len()].map(linear);
        let poses = poses(frames, "glTF")?;
        Ok(Figure { name: format!("dancer_{i}"), color, poses })
    };
    let figures: io::Result<Vec<Figure>> = group.outer_iter().enumerate().map(figure).collect();
    let figures = figures?;
    if figures.is_empty() {
        let refused = PoseError::Empty { format: "glTF" };
        return Err(io::Error::new(io::ErrorKind::InvalidInput, refused));
    }
    write(&figures, audio, out)
}

/// A body in the scene, and what it does.
struct Figure {
    name: String,
    /// Red, green and blue, linear, from 0 to 1.
    color: [f64; 3],
    poses: Poses,
}

/// The linear value of one of 256 steps of sRGB. Source: IEC 61966-2-1.
fn linear(step: u8) -> f64 {
    let x = f64::from(step) / 255.0;
    let value = if x <= 0.04045 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) };
    // As many digits as steps can be told apart by.
    (value * 1e4).round() / 1e4
}

fn write(figures: &[Figure], audio: Option<&str>, out: &mut dyn Write) -> io::Result<()> {
    let corners = body();
    let n_frames = figures.iter().map(|figure| figure.poses.len()).max().unwrap_or(0);
    let times_s: Vec<[f32; 1]> = (0..n_frames).map(|t| [frames_to_s(t) as f32]).collect();

    let mut buffer = Buffer::default();
    let positions: Vec<[f32; 3]> =
        corners.iter().map(|corner: &Corner| corner.position_m).collect();
    let normals: Vec<[f32; 3]> = corners.iter().map(|corner| corner.normal).collect();
    let position = buffer.add(&positions, "VEC3", Some(ARRAY_BUFFER));
    let normal = buffer.add(&normals, "VEC3", Some(ARRAY_BUFFER));
    let time = buffer.add(&times_s, "SCALAR", None);

    let mut parts = SceneParts::default();
    for (i, Figure { name, color, poses }) in figures.iter().enumerate() {
        let translations: Vec<[f32; 3]> =
            poses.position_m.iter().map(|p| p.map(|c| c as f32)).collect();
        let rotations: Vec<[f32; 4]> =
            poses.orientation.iter().map(|&q| in_gltf_order(q)).collect();
        let outputs = [
            ("translation", buffer.add(&translations, "VEC3", None)),
            ("rotation", buffer.add(&rotations, "VEC4", None)),
        ];
        for (path, output) in outputs {
            parts.channels.push(json!({
                "sampler": parts.samplers.len(),
                "target": { "node": i, "path": path },
            }));
            parts.samplers.push(json!({
                "input": time, "interpolation": "LINEAR", "output": output,
            }));
        }
        parts.materials.push(json!({
            "name": name,
            "pbrMetallicRoughness": {
                "baseColorFactor": [color[0], color[1], color[2], 1.0],
                "metallicFactor": 0.0,
                "roughnessFactor": 0.8,
            },
        }));
        parts.meshes.push(json!({
            "name": name,
            "primitives": [{
                "attributes": { "NORMAL": normal, "POSITION": position },
                "material": i,
                "mode": TRIANGLES,
            }],
        }));
        // At rest it stands where the motion begins.
        parts.nodes.push(json!({
            "mesh": i,
            "name": name,
            "rotation": rotations[0].map(f64::from),
            "translation": translations[0].map(f64::from),
        }));
    }

    let generator = concat!("motiongen ", env!("CARGO_PKG_VERSION"));
    let mut extras = Map::new();
    if let Some(audio) = audio {
        extras.insert("audio".to_owned(), audio.into());
    }
    extras.insert("fps".to_owned(), (FPS as u32).into());
    extras.insert("generator".to_owned(), generator.into());

    // Keys are in the order of the alphabet, here and in `Buffer`: the same bytes, whether a map of
    // serde_json keeps that order or the one of insertion, which depends on the features of the build.
    let document = json!({
        "accessors": buffer.accessors,
        "animations": [{
            "channels": parts.channels,
            "name": "motion",
            "samplers": parts.samplers,
        }],
        "asset": { "generator": generator, "version": "2.0" },
        "bufferViews": buffer.views,
        "buffers": [{ "byteLength": buffer.bytes.len() }],
        "extras": extras,
        "materials": parts.materials,
        "meshes": parts.meshes,
        "nodes": parts.nodes,
        "scene": 0,
        "scenes": [{ "nodes": (0..figures.len()).collect::<Vec<_>>() }],
    });

    let mut text = serde_json::to_vec(&document)?;
    text.resize(text.len().next_multiple_of(ALIGNMENT_BYTES), b' ');
    let bytes = buffer.bytes;
    let n_bytes = HEADER_BYTES + 2 * CHUNK_HEADER_BYTES + text.len() + bytes.len();
    out.write_all(MAGIC)?;
    out.write_all(&VERSION.to_le_bytes())?;
    out.write_all(&length(n_bytes)?)?;
    for (kind, chunk) in [(b"JSON", &text), (b"BIN\0", &bytes)] {
        out.write_all(&length(chunk.len())?)?;
        out.write_all(kind)?;
        out.write_all(chunk)?;
    }
    Ok(())
}

/// What the document has of every figure.
#[derive(Default)]
struct SceneParts {
    channels: Vec<Value>,
    samplers: Vec<Value>,
    materials: Vec<Value>,
    meshes: Vec<Value>,
    nodes: Vec<Value>,
}

/// Ours are (w, x, y, z), those of glTF (x, y, z, w).
fn in_gltf_order([w, x, y, z]: Quaternion) -> [f32; 4] {
    [x, y, z, w].map(|c| c as f32)
}

fn length(n_bytes: usize) -> io::Result<[u8; 4]> {
    let too_long = |_| {
        let message =
            format!("motion takes {n_bytes} bytes, and glTF holds up to 4 GiB; split the motion");
        io::Error::new(io::ErrorKind::InvalidInput, message)
    };
    u32::try_from(n_bytes).map(u32::to_le_bytes).map_err(too_long)
}

/// The one binary buffer, and what lies in it.
#[derive(Default)]
struct Buffer {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Buffer {
    /// Appends items of N floats, at least one, with a view and an accessor of their own; returns the
    /// number of the accessor. Floats leave the buffer at a multiple of four bytes.
    fn add<const N: usize>(
        &mut self,
        items: &[[f32; N]],
        kind: &str,
        target: Option<u32>,
    ) -> usize {
        let start = self.bytes.len();
        self.bytes.extend(items.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
        let mut view = json!({
            "buffer": 0,
            "byteLength": self.bytes.len() - start,
            "byteOffset": start,
        });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        let bound = |pick: fn(f32, f32) -> f32| -> Vec<f64> {
            // As f64 the digits name the exact number in whichever precision they are read.
            (0..N)
                .filter_map(|i| items.iter().map(|item| item[i]).reduce(pick).map(f64::from))
                .collect()
        };
        self.accessors.push(json!({
            "bufferView": self.views.len(),
            "componentType": FLOAT,
            "count": items.len(),
            "max": bound(f32::max),
            "min": bound(f32::min),
            "type": kind,
        }));
        self.views.push(view);
        self.accessors.len() - 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::channels::{Channel, MOTION_DIM};
    use crate::motion::quaternion::{dot, from_axis_angle};
    use ndarray::{Array2, Array3};
    use std::f64::consts::{FRAC_PI_2, SQRT_2};

    /// A file taken apart.
    struct Glb {
        document: Value,
        bytes: Vec<u8>,
    }

    impl Glb {
        fn of(frames: &Array2<f32>, audio: Option<&str>) -> Self {
            let mut file = Vec::new();
            write_glb(frames.view(), audio, &mut file).expect("memory");
            Self::taken_apart(&file)
        }

        fn taken_apart(file: &[u8]) -> Self {
            let word = |at: usize| {
                u32::from_le_bytes(file[at..at + 4].try_into().expect("4 bytes")) as usize
            };
            assert_eq!(&file[..4], b"glTF");
            assert_eq!((word(4), word(8)), (2, file.len()));
            let n_text = word(12);
            assert_eq!((&file[16..20], n_text % 4), (&b"JSON"[..], 0));
            let document = serde_json::from_slice(&file[20..20 + n_text]).expect("JSON");
            let binary = 20 + n_text;
            let n_binary = word(binary);
            assert_eq!((&file[binary + 4..binary + 8], n_binary % 4), (&b"BIN\0"[..], 0));
            assert_eq!(binary + 8 + n_binary, file.len());
            Self { document, bytes: file[binary + 8..].to_vec() }
        }

        fn number(&self, pointer: &str) -> usize {
            let value = self.document.pointer(pointer).and_then(Value::as_u64);
            value.unwrap_or_else(|| panic!("no number at {pointer}")) as usize
        }

        /// The items of an accessor, whose bounds and places are checked on the way.
        fn items(&self, accessor: usize) -> Vec<Vec<f32>> {
            let place = format!("/accessors/{accessor}");
            let entry = self.document.pointer(&place).expect("an accessor");
            assert_eq!(entry["componentType"], 5126);
            let width = match entry["type"].as_str() {
                Some("SCALAR") => 1,
                Some("VEC3") => 3,
                Some("VEC4") => 4,
                other => panic!("{other:?} is no type of ours"),
            };
            let view = format!("/bufferViews/{}", self.number(&format!("{place}/bufferView")));
            let start = self.number(&format!("{view}/byteOffset"));
            let n_bytes = self.number(&format!("{view}/byteLength"));
            assert_eq!((start % 4, n_bytes % (4 * width)), (0, 0));
            let floats: Vec<f32> = self.bytes[start..start + n_bytes]
                .chunks_exact(4)
                .map(|b| f32::from_le_bytes(b.try_into().expect("4 bytes")))
                .collect();
            let items: Vec<Vec<f32>> = floats.chunks_exact(width).map(<[f32]>::to_vec).collect();
            assert_eq!(items.len(), self.number(&format!("{place}/count")));
            for i in 0..width {
                let column = || items.iter().map(|item| item[i]);
                // Bounds of floats count in single precision; serde_json may read the last bit wrong.
                let bound = |name: &str| entry[name][i].as_f64().map(|x| x as f32);
                assert_eq!(bound("min"), column().reduce(f32::min));
                assert_eq!(bound("max"), column().reduce(f32::max));
            }
            items
        }

        /// Times, positions and orientations of the animation.
        fn animation(&self) -> [Vec<Vec<f32>>; 3] {
            let sampler = "/animations/0/samplers";
            assert_eq!(self.number("/animations/0/channels/0/sampler"), 0);
            assert_eq!(self.number("/animations/0/channels/1/sampler"), 1);
            let input = self.number(&format!("{sampler}/0/input"));
            assert_eq!(input, self.number(&format!("{sampler}/1/input")));
            let outputs = [0, 1].map(|i| self.number(&format!("{sampler}/{i}/output")));
            [input, outputs[0], outputs[1]].map(|accessor| self.items(accessor))
        }
    }

    /// Rises, and turns to its left by 0.5 rad a frame.
    fn spin(n: usize) -> Array2<f32> {
        let mut frames = Array2::zeros((n, MOTION_DIM));
        for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
            row[1] = 0.25 * t as f32;
            row[2] = -3.0;
            let q = from_axis_angle([0.0, 1.0, 0.0], 0.5 * t as f64);
            for (i, c) in Channel::Quaternion.range().zip(q) {
                row[i] = c as f32;
            }
        }
        frames
    }

    #[test]
    fn the_animation_holds_every_frame() {
        for n in [1, 2, 7, 30, 61] {
            let frames = spin(n);
            let glb = Glb::of(&frames, None);
            let [times_s, positions, rotations] = glb.animation();
            assert_eq!([times_s.len(), positions.len(), rotations.len()], [n; 3]);
            for t in 0..n {
                assert_eq!(times_s[t], [(t as f64 / 30.0) as f32]);
                assert_eq!(positions[t], [0.0, 0.25 * t as f32, -3.0]);
                let norm2: f64 = rotations[t].iter().map(|&c| f64::from(c).powi(2)).sum();
                assert!((norm2 - 1.0).abs() < 3e-7, "{t}: {norm2}");
            }
            assert_eq!(glb.number("/buffers/0/byteLength"), glb.bytes.len());
            // Neighbours lie on one hemisphere, even for a player that does not look.
            let q: Vec<Quaternion> =
                rotations.iter().map(|q| std::array::from_fn(|c| f64::from(q[c]))).collect();
            assert!(q.windows(2).all(|q| dot(q[0], q[1]) > 0.9));
        }
    }

    #[test]
    fn components_of_quaternions_are_in_the_order_of_gltf_and_unit() {
        let mut frames = spin(3);
        let q = from_axis_angle([0.0, 1.0, 0.0], FRAC_PI_2);
        for (i, c) in Channel::Quaternion.range().zip(q) {
            frames[[1, i]] = 3.0 * c as f32;
        }
        let glb = Glb::of(&frames, None);
        let [_, _, rotations] = glb.animation();
        assert_eq!(rotations[0], [0.0, 0.0, 0.0, 1.0]);
        let half = (1.0 / SQRT_2) as f32;
        for (found, wanted) in rotations[1].iter().zip([0.0, half, 0.0, half]) {
            assert!((found - wanted).abs() <= f32::EPSILON, "{:?}", rotations[1]);
        }
        assert_eq!(glb.document["nodes"][0]["rotation"], json!([0.0, 0.0, 0.0, 1.0]));
        assert_eq!(glb.document["nodes"][0]["translation"], json!([0.0, 0.0, -3.0]));
    }

    #[test]
    fn the_document_says_what_it_is() {
        let audio = "café \"live\".flac";
        let glb = Glb::of(&spin(5), Some(audio));
        let document = &glb.document;
        let generator = format!("motiongen {}", env!("CARGO_PKG_VERSION"));
        assert_eq!(document["asset"], json!({ "generator": generator, "version": "2.0" }));
        let wanted = json!({ "audio": audio, "fps": 30, "generator": generator });
        assert_eq!(document["extras"], wanted);
        assert_eq!(Glb::of(&spin(5), None).document["extras"].get("audio"), None);
        assert_eq!(document["scenes"][0]["nodes"], json!([0]));
        assert_eq!(document["nodes"][0]["name"], "body");
        let channel = |i: usize| &document["animations"][0]["channels"][i]["target"];
        assert_eq!(channel(0), &json!({ "node": 0, "path": "translation" }));
        assert_eq!(channel(1), &json!({ "node": 0, "path": "rotation" }));
        // Views of vertices have a target, those of the animation must not.
        let targets: Vec<Option<u64>> =
            (0..5_usize).map(|i| document["bufferViews"][i]["target"].as_u64()).collect();
        assert_eq!(targets, [Some(34962), Some(34962), None, None, None]);
    }

    #[test]
    fn the_mesh_has_a_normal_for_every_corner_and_whole_triangles() {
        let glb = Glb::of(&spin(2), None);
        let attributes = "/meshes/0/primitives/0/attributes";
        let positions = glb.items(glb.number(&format!("{attributes}/POSITION")));
        let normals = glb.items(glb.number(&format!("{attributes}/NORMAL")));
        assert_eq!((positions.len(), positions.len() % 3), (normals.len(), 0));
        assert_eq!(glb.number("/meshes/0/primitives/0/mode"), 4);
    }

    #[test]
    fn every_dancer_of_a_group_is_a_node_of_its_own() {
        let mut group = Array3::zeros((3, 7, MOTION_DIM));
        for (i, mut dancer) in group.outer_iter_mut().enumerate() {
            dancer.assign(&spin(7));
            dancer.column_mut(0).fill(1.5 * i as f32);
        }
        let mut file = Vec::new();
        write_group_glb(group.view(), Some("a.wav"), &mut file).expect("memory");
        let glb = Glb::taken_apart(&file);
        assert_eq!(glb.document["scenes"][0]["nodes"], json!([0, 1, 2]));
        assert_eq!(glb.document["animations"].as_array().map(Vec::len), Some(1));
        for i in 0..3_usize {
            let node = &glb.document["nodes"][i];
            assert_eq!(node["name"], format!("dancer_{i}"));
            assert_eq!(
                (&node["mesh"], &node["translation"][0]),
                (&json!(i), &json!(1.5 * i as f64))
            );
            assert_eq!(glb.document["meshes"][i]["primitives"][0]["material"], i);
            for (k, path) in ["translation", "rotation"].into_iter().enumerate() {
                let channel = &glb.document["animations"][0]["channels"][2 * i + k];
                assert_eq!(channel["target"], json!({ "node": i, "path": path }));
                let sampler = format!("/animations/0/samplers/{}", channel["sampler"]);
                let items = glb.items(glb.number(&format!("{sampler}/output")));
                assert_eq!(items.len(), 7);
                assert!(k == 1 || items.iter().all(|place| place[0] == 1.5 * i as f32));
            }
        }
        // 0x72 of sRGB is 0.1683 of the light of white.
        let color = &glb.document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"];
        assert_eq!(color, &json!([0.0, 0.1683, 0.4452, 1.0]));
        let nobody = Array3::zeros((0, 7, MOTION_DIM));
        assert_eq!(
            write_group_glb(nobody.view(), None, &mut Vec::new()).expect_err("nobody").to_string(),
            "motion has no frames, and glTF holds at least one; write it as npy or csv"
        );
    }

    #[test]
    fn the_same_motion_makes_the_same_bytes_and_no_pose_none() {
        let written = |frames: &Array2<f32>| {
            let mut bytes = Vec::new();
            write_glb(frames.view(), Some("a.wav"), &mut bytes).map(|()| bytes)
        };
        let mut frames = spin(9);
        assert_eq!(written(&frames).expect("memory"), written(&frames).expect("memory"));
        frames[[4, 2]] = f32::NAN;
        assert_eq!(
            written(&frames).expect_err("no pose").to_string(),
            "channel position_z is NaN at frame 4, and glTF holds finite numbers alone; write the \
             motion as npy or csv to look at it"
        );
    }
}
