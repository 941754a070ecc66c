# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Configurations that also change fields of stages which are no settings."""

from __future__ import annotations

from dataclasses import replace

from surfel_mapper.config import Config, declarations


def config_of(mapping):
    """Return the configuration with some settings and fields, by ``stage.name``."""
    known = {declared.name for declared in declarations()}
    config = Config.from_mapping({name: v for name, v in mapping.items() if name in known})
    for name, value in mapping.items():
        if name not in known:
            stage, _, key = name.removeprefix('layers.').partition('.')
            config = replace(config, **{stage: replace(getattr(config, stage), **{key: value})})
    return config
