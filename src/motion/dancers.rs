//! Motion of all dancers on one music: a soloist, or a group in one frame of reference.

use ndarray::{Array3, Axis};
use thiserror::Error;

use super::channels::MOTION_DIM;
use super::group::MAX_DANCERS;
use super::trajectory::{ChannelLimits, Trajectory, TrajectoryError};

/// Frames by which the dancers of a group may differ in length; what is longer is cut.
const LENGTH_TOLERANCE_FRAMES: usize = 1;

/// Why trajectories make no group.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum DancersError {
    /// No dancer, or too many.
    #[error(
        "motion has {n_dancers} dancers, expected 1 to {MAX_DANCERS}; split it into several phrases"
    )]
    Count { n_dancers: usize },
    /// A dancer who dances longer or shorter than the first.
    #[error(
        "dancer {dancer} has {n_frames} frames and dancer 0 has {n_first}; the dancers of a group may differ by \
         {LENGTH_TOLERANCE_FRAMES} frame, so cut them to one length"
    )]
    Length { dancer: usize, n_frames: usize, n_first: usize },
    /// A dancer whose frames no trajectory can have.
    #[error("dancer {dancer}: {source}")]
    Dancer { dancer: usize, source: TrajectoryError },
}

impl DancersError {
    /// The kind of defect as one word for tables.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Count { .. } => "shape",
            Self::Length { .. } => "length_mismatch",
            Self::Dancer { source, .. } => source.kind(),
        }
    }
}

/// Trajectories of 1 to [`MAX_DANCERS`] dancers, all of one length.
#[derive(Clone, Debug, PartialEq)]
pub struct Dancers(Vec<Trajectory>);

impl Dancers {
    /// Makes a group of trajectories in one frame of reference, cut to the shortest where they differ by a frame.
    ///
    /// Errors: [`DancersError::Count`], [`DancersError::Length`].
    pub fn new(dancers: Vec<Trajectory>) -> Result<Self, DancersError> {
        let n_dancers = dancers.len();
        if !(1..=MAX_DANCERS).contains(&n_dancers) {
            return Err(DancersError::Count { n_dancers });
        }
        let lengths = || dancers.iter().map(Trajectory::n_frames);
        let (shortest, longest) = (lengths().min().unwrap_or(0), lengths().max().unwrap_or(0));
        if longest - shortest > LENGTH_TOLERANCE_FRAMES {
            let n_first = dancers[0].n_frames();
            let off = |n_frames: &(usize, usize)| n_frames.1.abs_diff(n_first);
            let farthest = lengths().enumerate().rev().max_by_key(off);
            let (dancer, n_frames) = farthest.unwrap_or((0, n_first));
            return Err(DancersError::Length { dancer, n_frames, n_first });
        }
        Ok(Self(dancers.into_iter().map(|dancer| cut(dancer, shortest)).collect()))
    }

    /// Makes a group of frames, shape `[N, T, 25]`, without looking at their values.
    ///
    /// Errors: [`DancersError::Count`], and [`DancersError::Dancer`] where `T` is 0 or there are not 25 channels.
    pub fn of_frames(frames: Array3<f32>) -> Result<Self, DancersError> {
        let n_dancers = frames.len_of(Axis(0));
        if !(1..=MAX_DANCERS).contains(&n_dancers) {
            return Err(DancersError::Count { n_dancers });
        }
        let trajectory = |(dancer, frames): (usize, ndarray::ArrayView2<f32>)| {
            Trajectory::new(frames.to_owned())
                .map_err(|source| DancersError::Dancer { dancer, source })
        };
        frames.outer_iter().enumerate().map(trajectory).collect::<Result<_, _>>().map(Self)
    }

    /// Number of dancers `N`.
    pub fn n_dancers(&self) -> usize {
        self.0.len()
    }

    /// Number of frames `T`, the same of each dancer.
    pub fn n_frames(&self) -> usize {
        self.0[0].n_frames()
    }

    /// The trajectories, in order of the dancers.
    pub fn trajectories(&self) -> &[Trajectory] {
        &self.0
    }

    /// The trajectories themselves, in order of the dancers.
    pub fn into_trajectories(self) -> Vec<Trajectory> {
        self.0
    }

    /// All values, shape `[N, T, 25]`.
    pub fn to_array(&self) -> Array3<f32> {
        let mut frames = Array3::zeros((self.n_dancers(), self.n_frames(), MOTION_DIM));
        for (mut of_dancer, trajectory) in frames.outer_iter_mut().zip(&self.0) {
            of_dancer.assign(&trajectory.view());
        }
        frames
    }

    /// Checks each dancer as [`Trajectory::check`] does; a soloist's error is that of the trajectory.
    ///
    /// Errors: the first [`DancersError::Dancer`].
    pub fn check(&self, limits: &ChannelLimits) -> Result<(), DancersError> {
        self.0.iter().enumerate().try_for_each(|(dancer, trajectory)| {
            trajectory.check(limits).map_err(|source| DancersError::Dancer { dancer, source })
        })
    }
}

impl From<Trajectory> for Dancers {
    /// A soloist.
    fn from(trajectory: Trajectory) -> Self {
        Self(vec![trajectory])
    }
}

fn cut(trajectory: Trajectory, n_frames: usize) -> Trajectory {
    if trajectory.n_frames() == n_frames {
        return trajectory;
    }
    let frames = trajectory.view().slice(ndarray::s![..n_frames, ..]).to_owned();
    Trajectory::new(frames).expect("invariant: a trajectory's frames, at least one of them")
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;

    fn trajectory(n_frames: usize, x: f32) -> Trajectory {
        Trajectory::new(Array2::from_elem((n_frames, MOTION_DIM), x)).expect("frames")
    }

    fn refusal(lengths: &[usize]) -> (String, &'static str) {
        let dancers = lengths.iter().map(|&n| trajectory(n, 0.0)).collect();
        let error = Dancers::new(dancers).expect_err("no group");
        (error.to_string(), error.kind())
    }

    #[test]
    fn dancers_are_cut_to_the_shortest_where_a_frame_is_too_many() {
        let dancers = vec![trajectory(8, 1.0), trajectory(7, 2.0), trajectory(8, 3.0)];
        let group = Dancers::new(dancers).expect("a group");
        assert_eq!((group.n_dancers(), group.n_frames()), (3, 7));
        let frames = group.to_array();
        assert_eq!(frames.dim(), (3, 7, MOTION_DIM));
        for (dancer, x) in [1.0, 2.0, 3.0].into_iter().enumerate() {
            assert!(frames.index_axis(Axis(0), dancer).iter().all(|&found| found == x));
        }
        assert_eq!(Dancers::of_frames(frames), Ok(group));
    }

    #[test]
    fn what_is_no_group_is_refused_with_both_numbers() {
        assert_eq!(
            refusal(&[]),
            (
                "motion has 0 dancers, expected 1 to 16; split it into several phrases".into(),
                "shape"
            )
        );
        assert_eq!(
            refusal(&[3; 17]),
            (
                "motion has 17 dancers, expected 1 to 16; split it into several phrases".into(),
                "shape"
            )
        );
        let unequal = |dancer: usize, n: usize| {
            let message = format!(
                "dancer {dancer} has {n} frames and dancer 0 has 40; the dancers of a group may differ by 1 \
                 frame, so cut them to one length"
            );
            (message, "length_mismatch")
        };
        assert_eq!(refusal(&[40, 41, 31, 42]), unequal(2, 31));
        assert_eq!(refusal(&[40, 42]), unequal(1, 42));
        // Neither is far from the first.
        assert_eq!(refusal(&[40, 39, 41]), unequal(1, 39));
    }

    #[test]
    fn a_dancer_that_cannot_be_is_named() {
        let mut frames = Array3::zeros((2, 3, MOTION_DIM));
        frames.slice_mut(ndarray::s![.., .., 9]).fill(1.0);
        frames[[1, 2, 4]] = f32::NAN;
        let group = Dancers::of_frames(frames).expect("a group");
        let error = group.check(&ChannelLimits::Wide).expect_err("not finite");
        assert_eq!(error.kind(), "non_finite");
        assert_eq!(
            error.to_string(),
            "dancer 1: channel velocity_y is NaN at frame 2 (1 non-finite values in all); repair or remove the \
             phrase"
        );
        let error = Dancers::of_frames(Array3::zeros((2, 0, MOTION_DIM))).expect_err("no frames");
        assert_eq!(
            error.to_string(),
            "dancer 0: trajectory has shape [0, 25], expected [T, 25] with T >= 1; write one row per frame in \
             the channel order of the format"
        );
    }
}
