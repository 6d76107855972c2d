"""Settings of registration: Table 1 of the paper, and what we add to it."""

from __future__ import annotations

from pydantic import AliasChoices, Field

from worker.cloud.settings import StrictModel


class RegistrationSettings(StrictModel):
    """Table 1 of the paper, and what we add to it."""

    voxel_size: float = Field(0.05, gt=0, le=0.5, description="metres; the scan is sampled before ICP")
    max_correspondence_distance: float = Field(
        0.05, gt=0, le=1, description="metres; of the last level of ICP"
    )
    normal_radius: float = Field(0.10, gt=0, le=1, description="metres")
    normal_max_neighbors: int = Field(30, ge=3, le=200)
    min_fitness: float = Field(
        0.55, ge=0, le=1, description="share of the scan's points with a correspondence"
    )
    max_inlier_rmse: float = Field(0.05, gt=0, le=1, description="metres")
    coarse_distances: tuple[float, ...] = Field(
        (0.6, 0.3, 0.1),
        description="metres; correspondence distances of earlier levels, for starts up to half a metre off",
    )
    max_iterations: int = Field(30, ge=1, le=1000, description="of ICP at each level")
    search_resolutions: tuple[float, ...] = Field(
        (0.3, 0.2, 0.15), description="metres; of the global registration, in this order; () switches it off"
    )
    search_seeds: int = Field(2, ge=1, description="draws of RANSAC at each resolution")
    min_inlier_ratio: float = Field(
        0.8,
        ge=0,
        le=1,
        validation_alias=AliasChoices("min_inlier_ratio", "min_agreement"),  # the API's name for it
        description="share of the overlap on a common surface, in the worse of both directions",
    )
    min_inlier_ratio_without_prior: float = Field(
        0.85,
        ge=0,
        le=1,
        description="the same where the pose is not consistent with a prior and the sensor's place is known",
    )
    search_margin: float = Field(
        0.03, ge=0, le=1, description="inlier ratio above the least that ends the global registration"
    )
    min_overlap: float = Field(0.5, ge=0, le=1, description="share of the scan that the map covers")
    min_overlap_near_prior: float = Field(0.3, ge=0, le=1, description="the same near a prior")
    max_ambiguity_distance: float = Field(
        0.05, gt=0, description="metres; as good a pose farther away than this leaves the scan undecided"
    )
    prior_distance: float = Field(1.0, ge=0, description="metres; how far a given prior may be off")
    prior_angle: float = Field(0.26, ge=0, description="radians; likewise (15 degrees)")
    max_free_space_violation: float = Field(
        0.004,
        ge=0,
        le=1,
        description="share of one scan's points that stand where another scan saw free space",
    )
    max_free_space_violation_near_prior: float = Field(0.03, ge=0, le=1, description="the same near a prior")
    min_eigenvalue: float = Field(0.002, ge=0, description="smallest eigenvalue of the scene's normal matrix")
    min_points: int = Field(500, ge=6, description="voxels that a scan needs to be registered at all")
