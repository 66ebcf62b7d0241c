//! Motion: the 25-channel root trajectory at [`crate::units::FPS`] and its making from captures.
//!
//! Conventions, the same in every file of this room:
//!
//! * metres, seconds, radians; +Y up, +Z forward, +X right, right-handed;
//! * quaternions are Hamilton `(w, x, y, z)`, unit, and rotate body to world; their sign is
//!   continuous in time (`q[t] · q[t+1] >= 0`), not fixed to `w >= 0`;
//! * derivatives are forward differences: `v[t] = (p[t+1] - p[t]) FPS`,
//!   `a[t] = (v[t+1] - v[t]) FPS`, and angular velocity is in world axes,
//!   `ω[t] = 2 log(q[t+1] q[t]*) FPS`;
//! * the phase is the bar phase in `[0, 1)`, 0 on the downbeat.
//!
//! Everything here is pure: text and numbers in, numbers or a named error out.

pub mod augment;
mod banded;
mod beat_list;
pub mod blend;
pub mod bvh;
pub mod capture;
pub mod channels;
pub mod choreography;
pub mod clock;
pub mod correction;
mod dancers;
pub mod exchange;
pub mod formats;
pub mod group;
pub mod kinematics;
pub mod layout;
pub mod locking;
pub mod lowpass;
pub mod normalizer;
pub mod npy;
pub mod npz;
pub mod phase;
pub mod placement;
pub mod postprocess;
pub mod quantile;
pub mod quaternion;
pub mod rates;
pub mod spline;
pub mod style;
pub mod style_name;
pub mod text;
pub mod trajectory;
pub mod vector;

pub use bvh::{Bvh, BvhError, BvhNote};
pub use capture::{
    Axis, Capture, CaptureAccount, CaptureError, CaptureNote, GroupCapture, RigidTrack,
    convert_bvh, convert_capture, convert_captures, convert_track, convert_tracks,
};
pub use channels::{BODY, CHANNEL_NAMES, Channel, MOTION_DIM, channel_unit};
pub use clock::{CLOCK_DIM, CLOCK_NAMES, clock};
pub use dancers::{Dancers, DancersError};
pub use kinematics::Poses;
pub use layout::{BodyColumns, ColumnGroup, ColumnRole, Columns, Layout};
pub use normalizer::Normalizer;
pub use phase::{Beats, BeatsError, BeatsPerBarSource, bar_phase};
pub use placement::Placement;
pub use trajectory::{ChannelLimits, Trajectory, TrajectoryError};
