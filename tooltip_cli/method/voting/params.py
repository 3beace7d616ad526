"""Parameters of the voting method; none of them is in the paper."""

from __future__ import annotations

from dataclasses import dataclass, field

PUT_RIGHT = ("auto", "none", "time", "all")
"""What of a rig may be put right: clocks and camera where the images disagree about the end,
nothing, the clocks, or clocks and camera."""


@dataclass(frozen=True)
class PairingParams:
    """Which frames are looked at, and with which partners."""

    frames: int = 200  # at most, spread over the hand's orientations
    probe_radius: float = 0.15  # metres from the hand's origin: where a tool's end is expected
    displacement_px: float = 4.5  # wanted motion of such points between partners, whole images
    min_displacement_px: float = 2.0  # less shows nothing
    max_displacement_px: float = 7.0  # more leaves the search window
    max_gap: int = 15  # frames between partners
    levels: int = 3  # sizes of images, each half the one before, that are matched until it fits

    @property
    def smallest(self) -> int:
        """How many times smaller the smallest images are than whole ones."""
        return int(2 ** (self.levels - 1))

    @property
    def fastest_px(self) -> float:
        """Most that such points may move by between neighbouring images."""
        return self.smallest * self.max_displacement_px


@dataclass(frozen=True)
class MovingParams:
    """Which edges count as moving."""

    block: int = 5  # pixels
    search: int = 11  # pixels
    tau: float = 80.0  # grey levels
    alpha: float = 0.25  # px^2
    blur_px: float = 1.0  # standard deviation of the Gaussian that tames sensor noise
    canny_low: float = 20.0  # on the blurred image, at a noise of one grey level or less
    canny_ratio: float = 2.5  # high threshold over low
    background_edges: int = 2000  # about so many, row by row, that the background is fitted to
    change: float = 4.0  # grey levels that a pixel near a moving edge changes by, at least
    min_weight: float = 2.0  # Mahalanobis distance to the background
    reach: float = 0.35  # metres from the hand's origin: where the tool can be


@dataclass(frozen=True)
class SilhouetteParams:
    """What counts as standing before the background."""

    samples: int = 31  # images, evenly spread, that the background is learnt from
    tolerance: float = 3.0  # standard deviations of a pixel that it may differ by
    least_contrast: float = 8.0  # grey levels, at least
    most_contrast: float = 60.0  # where more is needed, nothing is known
    min_seen: float = 0.6  # share of the samples that must show the background at a pixel
    min_area: int = 30  # pixels; smaller pieces are specks
    max_share: float = 0.5  # of an image that may stand before the background


@dataclass(frozen=True)
class HullParams:
    """The volume that stands before the background in every image; lengths in metres."""

    coarse: float = 0.008  # voxels of the first pass
    fine: float = 0.004  # voxels of the second
    margin: float = 0.4  # of a voxel, that silhouettes are widened by
    max_missing: float = 0.08  # share of the images in which a voxel of hand or tool may be missing
    min_seen: float = 0.3  # share of the images that must say something of a voxel
    max_cover: float = 0.5  # share of the images in which the hand may stand before a pixel
    confirmed: float = 0.012  # from a voted voxel, within which a voxel is surely no bulge
    likely: float = 0.04  # the same, within which it may be what shows no edges


@dataclass(frozen=True)
class VotingParams:
    """How edges become points in the hand frame, and points an end."""

    depths: int = 64  # samples of each edge's depth profile over the reach
    clip: float = 6.0  # largest log-likelihood ratio that one partner may contribute
    prediction_variance: float = 0.25  # px^2, error of the predicted motion
    coarse: float = 0.008  # metres, voxels of the first vote
    fine: float = 0.004  # metres, voxels of the second
    min_score: float = 0.1  # share of expected frames that a voxel is seen in, first vote
    volume_weight: float = 4.0  # log-volume against log-likelihood ratio in the choice of depth
    rounds: int = 1  # of giving each edge a depth and voting again


@dataclass(frozen=True)
class EndParams:
    """What counts as the tool's end; lengths in metres."""

    voxel: float = 0.004
    min_frames: float = 6.0  # that agree on a voxel, smoothed over neighbours
    min_share: float = 0.12  # of what the tool's clearest voxels have
    min_voxels: int = 8  # smaller pieces are specks
    far_share: float = 0.8  # of the farthest's distance from wrist or grip, that ends have
    other_end_support: float = 0.5  # of the most support, without which another end does not count
    other_end_share: float = 0.65  # of the first's distance from the wrist times that from the grip
    wanted_support: float = 0.4  # instead, where a direction says which end is meant
    wanted_share: float = 0.4  # the same, of each of the two distances
    opposite_share: float = 0.5  # of the first end's distance from the grip, beyond the hand
    thicker: float = 1.3  # than the first: an end there counts, as what is thin may be a cord
    end_separation: float = 0.05  # an end is the farthest voxel within this distance
    neighbourhood: float = 0.14  # of the far voxel, that its axis is found from
    short_slab: float = 0.03  # the last stretch, that must be slender
    wide: float = 0.08  # how far across the axis the short slab reaches
    long_slab: float = 0.05  # the stretch whose direction is measured
    slab_radius: float = 0.045  # how far across the axis the long slab reaches
    cone_deg: float = 95.0  # the axis lies within this angle of grip-to-end
    outwards_weight: float = 0.3  # preference for axes that point from the grip to the end
    far_tolerance: float = 0.008  # the far voxel lies on the end face, to this
    refine_deg: float = 8.0
    face_cone_deg: float = 40.0
    face_thickness: float = 0.0025
    face_turn_weight: float = 0.6
    face_gain: float = 1.3  # how much sharper an end face must be to turn the axis far
    middle_slab: float = 0.012  # the stretch whose middle is the tip
    slanted_slab: float = 0.03  # tried for a far side too: a thin one may hold a bit of rim only
    side_quantile: float = 0.03  # what lies farther out does not make a side
    surface_voxel: float = 0.003
    surface_frames: int = 3


@dataclass(frozen=True)
class RefineParams:
    """How an end is put right by the edges of every image; lengths in metres.

    Where a length and one in pixels are given, the larger of the two holds at the tool's depth.
    """

    reach: float = 0.05  # how far back from the end edges are looked at
    beyond: float = 0.06  # how far beyond it: a slanted end's rim lies as far as the end is wide
    max_move: float = 0.012  # from the voted end; what moves farther has found something else
    min_ratio: float = 0.5  # log-likelihood ratio, at the tool's depth, of an edge that counts
    min_sine: float = 0.35  # of the angle between axis and line of sight
    min_sine_at_end: float = 0.5  # the same, where the end's own sides are looked at
    min_edges: int = 5  # in a stretch, for it to have sides
    side_quantile: float = 0.03  # what lies farther out does not make a side
    end_slab: float = 0.005  # the last stretch, whose middle is the tip
    end_slab_px: float = 4.0
    loss_px: float = 1.0  # scale of the robust loss
    first_loss_px: float = 4.0  # the same at first
    missed_weight: float = 0.2  # of a side that lies too far inside: edges are missed, not made up
    side_weight: float = 0.25  # of a side alone, against the middle between two
    odd_width: float = 0.003  # that half a width differs by where a side was missed
    prior_weight: float = 0.01  # of what decides where frames do not, for each frame
    rounds: int = 10  # of looking again from where the end is now
    point_share: float = 0.73  # of the frames whose farthest edges meet, at a pointed end
    point_tolerance: float = 0.002  # within which they meet
    point_tolerance_px: float = 2.5
    point_width: float = 0.006  # across, that is looked at about a pointed end at first
    start_turn_deg: float = 29.0  # of the other axes that are tried where the first one fails
    good_agreement: float = 0.5  # share of frames that fit, above which no other axis is tried
    min_agreement: float = 0.35  # below this, the voted end is kept
    min_frames: int = 20  # that show the end
    resamplings: int = 30  # of the frames, for the uncertainty


@dataclass(frozen=True)
class OutlineParams:
    """How an end is put right by the outlines of silhouettes; lengths in metres."""

    max_move: float = 0.03  # from a start; what moves farther has found something else
    same_end: float = 0.06  # rough ends nearer to one another than this are one end's
    radius_factors: tuple[float, ...] = (0.5, 1.0, 2.0)  # of the rough radius, that are tried
    frames_at_first: int = 40  # that all starts are tried on
    rounds_at_first: int = 6
    least_frames: int = 8  # of those, that must show the end
    as_good: float = 0.86  # share of the most support, and of its agreement: that explains as much
    starts_kept: int = 4  # unlike ones, that are then tried on all frames
    point_share: float = 0.6  # as in RefineParams; the background beside the point decides
    # to each side of a point, that are looked at
    point_widths: tuple[float, ...] = (0.003, 0.0045, 0.006)
    same_place: float = 0.003  # a point nearer to the end's middle than this is the end
    beside_depth: float = 0.003  # behind a point, where the background shows beside it
    min_missing_beside: float = 0.12  # share of the images that must show it
    min_agreement: float = 0.5  # of frames, below which moving edges may know better


@dataclass(frozen=True)
class CalibrationParams:
    """What corrections of clocks and camera are expected, and when one is made."""

    time_prior: float = 0.03  # seconds, standard deviation of the clocks' offset
    rotation_prior_deg: float = 1.0  # of the camera about each axis
    translation_prior: float = 0.005  # metres, of the camera along each axis
    radius_factors: tuple[float, ...] = (1.0, 2.0)  # of an end's, that are tried
    enough_support: float = 0.7  # of what the images could show of the end, to try no more
    rounds: int = 10
    settled: float = 0.003  # of those deviations, smallest step worth another round
    certain: float = 3.0  # standard deviations that an offset must have to be used
    camera_gain: float = 0.05  # share of frames that must fit besides, for a camera's correction
    common_error: float = 10.0  # variance of what is wrong in all frames alike, over that of chance
    determined: float = 0.33  # of those deviations, largest that still determines a direction
    agreement_gain: float = 0.065  # of what images show of the end, that must fit besides, unasked


@dataclass(frozen=True)
class TrustParams:
    """When an answer is refused, and how uncertain one is at least."""

    min_frames: int = 30  # chosen frames
    min_view_angle_deg: float = 15.0  # between the camera's directions, seen from the hand
    min_score: float = 0.6  # best share of expected frames in which a voxel was seen
    min_consistent: float = 0.55  # share of moving edges that fit something fixed to the hand
    fast_consistent: float = 0.65  # the same where images are halved
    convincing_agreement: float = 0.65  # of frames on the end: with it, less may be consistent
    doubtful_agreement: float = 0.6  # of what images show of the end: less is said
    doubtful_std: float = 0.005  # metres, of the end in any direction: more is said
    min_in_view: float = 0.5  # share of the frames in which the tip lies inside the image
    halves: int = 6  # random halves of the frames that the end is found from again
    seed: int = 0  # of the halves
    voted_floor: float = 0.0015  # metres, standard deviation of a voted end, at least
    voted_floor_per_radius: float = 0.1  # the same, for each metre of the end's radius
    floor: float = 0.0005  # metres, standard deviation that no number of frames removes
    floor_px: float = 1.0  # the same in pixels; the larger holds
    full_agreement: float = 0.8  # of frames: below, the floor rises, clocks and camera are doubted
    disagreement: float = 15.0  # by this factor for the whole share
    axis_floor_deg: float = 3.0  # standard deviation of the axis, at least


@dataclass(frozen=True)
class VotingSettings:
    """Everything that an estimate by voting depends on."""

    pairing: PairingParams = field(default_factory=PairingParams)
    moving: MovingParams = field(default_factory=MovingParams)
    silhouette: SilhouetteParams = field(default_factory=SilhouetteParams)
    hull: HullParams = field(default_factory=HullParams)
    voting: VotingParams = field(default_factory=VotingParams)
    end: EndParams = field(default_factory=EndParams)
    refine: RefineParams = field(default_factory=RefineParams)
    outline: OutlineParams = field(default_factory=OutlineParams)
    calibration: CalibrationParams = field(default_factory=CalibrationParams)
    trust: TrustParams = field(default_factory=TrustParams)
    prefer: tuple[float, float, float] | None = (
        None  # direction of the end that is meant, hand frame
    )
    put_right: str = "auto"  # one of `PUT_RIGHT`
