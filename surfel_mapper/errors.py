# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Every exception that this package raises on purpose.

    SurfelMapperError
      ConfigError          a setting is unknown, of the wrong type or out of bounds  (ValueError)
      CloudFormatError     a PointCloud2 that cannot be decoded                       (ValueError)
      PoseError            no pose for a scan, and waiting will not bring one
        PoseNotYetError    the transforms needed are older than the stamp: wait
      MapError             an operation that a surfel map cannot carry out
        MapLimitError      a voxel index or a count beyond what the integers hold     (ValueError)
        NotInMapError      removing moments that the map does not hold                (ValueError)
      FilterError          a filter cannot work on a scan                             (ValueError)
      AlignmentError       scans, pairs or poses from which no poses follow           (ValueError)
      ModelError           points that no models can be fitted to                     (ValueError)
      BagError             a bag that cannot be read, or lacks what is asked of it
      FileFormatError      any other file that cannot be read or is damaged           (ValueError)
      SubscriberError      nobody subscribes to what is to be published
      ClusterError         workers or a scheduler that cannot be reached, or die again and again
      DependencyError      an optional package is missing; says how to install it     (ImportError)

A caller that only wants to go on with the next scan catches SurfelMapperError.
"""


class SurfelMapperError(Exception):
    """Base of all errors of this package."""


class ConfigError(SurfelMapperError, ValueError):
    """A setting is unknown, of the wrong type or out of bounds."""


class CloudFormatError(SurfelMapperError, ValueError):
    """A PointCloud2 whose fields, sizes or datatypes do not fit together."""


class PoseError(SurfelMapperError):
    """There is no pose at the stamp asked for, and waiting will not bring one."""


class PoseNotYetError(PoseError):
    """The newest transform needed is older than the stamp asked for: it may still come."""


class MapError(SurfelMapperError):
    """An operation that a surfel map cannot carry out; the map is unchanged."""


class MapLimitError(MapError, ValueError):
    """A voxel index or a number of points is beyond what the integers of the map hold."""


class NotInMapError(MapError, ValueError):
    """Moments to be removed are not, or not completely, in the map."""


class FilterError(SurfelMapperError, ValueError):
    """A filter cannot work on a scan: a column is missing, or a value is not what it takes."""


class AlignmentError(SurfelMapperError, ValueError):
    """A graph of scans, its pairs or its poses are not fit for alignment; nothing has changed."""


class ModelError(SurfelMapperError, ValueError):
    """Points, or a viewpoint, that no models can be fitted to."""


class BagError(SurfelMapperError):
    """A bag cannot be read, or lacks the topic or the poses asked for."""


class FileFormatError(SurfelMapperError, ValueError):
    """A file other than a bag cannot be read: of another format or version, or damaged."""


class SubscriberError(SurfelMapperError):
    """Nobody subscribes to what is to be published."""


class ClusterError(SurfelMapperError):
    """Workers or their scheduler cannot be reached, or died again and again."""


class DependencyError(SurfelMapperError, ImportError):
    """A package that the requested feature needs is not installed."""
