# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What pip and colcon install.

pip makes ``surfel-mapper`` in bin/. The executables ``node`` and ``replay``, which ``ros2 run``
starts, are installed as data into lib/surfel_mapper and nowhere else: a script called node in
the bin/ of an environment would hide Node.js. An editable install has no data, so there only
``surfel-mapper node`` works.

Everything is stated here and nothing in pyproject.toml, which colcon reads only in part.
"""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'surfel_mapper'

# A reserved domain, which stands for the address that the project does not have yet: release.yml
# publishes nothing while it is here, in package.xml or in CITATION.cff.
SITE = 'https://surfel-mapper.example'

REQUIRED = [
    # The lower bounds are what Ubuntu 24.04 has, the system of ROS 2 Jazzy, so that its apt
    # packages are kept; of numba, rosbags and mcap, which it lacks, the oldest that pass tests.
    'numpy>=1.26',  # arrays; 1.26 is what the messages of ROS from apt are compiled for
    'scipy>=1.11',  # rotations and spatial search beyond the kernels
    'numba>=0.61',  # compiles the kernels; 0.61 is the first for Python 3.13
    # bags of ROS 1 and 2 without ROS; brings lz4 and backports.zstd. Bounded above, because
    # bags/_rosbags.py fills tables of its readers that are no public interface
    'rosbags>=0.11.7,<0.12',
    'mcap>=1.1',  # reads mcap files that a killed recorder left without an index; MIT
    'PyYAML>=6.0',  # settings
    'tqdm>=4.66',  # progress on a terminal
    'argcomplete>=3.1',  # Tab completes verbs, options and settings; ros2 itself needs it
    'matplotlib>=3.6',  # map.png
    'pillow>=10',  # images packed as JPEG and PNG; a tenth of opencv, and matplotlib brings it
]

# Jazzy from PyPI, for machines without a ROS of their own; never beside one from apt. The wheels
# are for this machine alone; elsewhere nothing is installed, and the node says what it misses.
WHEELS = 'platform_machine == "x86_64" and python_version < "3.14"'
ROS = [
    f'ros-jazzy-rclpy[fastrtps]>=7.1; {WHEELS}',  # the extra is the middleware
    f'ros-jazzy-common-interfaces>=5.3; {WHEELS}',  # all messages but tf2_msgs, which PyPI lacks
]

FORMATS = [
    'pyarrow>=14.0.1',  # maps as Parquet; 14.0.0 runs what a file tells it to, CVE-2023-47248
    'python-neo-lzf>=0.3',  # scans in compressed PCD files
]

CLUSTER = [
    'dask>=2024.4',  # bags on many processes and machines
    'distributed>=2024.4',  # likewise: its scheduler and workers
    'cryptography>=42.0.4',  # TLS between them; earlier ones have CVE-2024-26130
    'pyarrow>=14.0.1',  # the tiles of a map as Parquet
]

LAS = [
    'laspy[lazrs]>=2.5',  # scans in LAS and LAZ files; lazrs unpacks LAZ
    'pyproj>=3.6',  # units of coordinate systems in them; MIT
]

CLOUDS = [
    'pye57>=0.4.11',  # scans in E57 files; MIT
    'vtk>=9.2',  # points in VTK files, 140 MB; BSD
]

OUSTER = [
    # captures of Ouster lidars; BSD-3-Clause, a part under a licence of Ouster's own. Later ones
    # pin a rosbags older than ours; this one is for Python 3.10 to 3.12, and takes numpy 1.26
    'ouster-sdk>=0.12,<0.13; python_version < "3.13"',
]

LOOPS = [
    'map-closures>=2.2',  # recognises places that were seen before; MIT, wheels for 3.10 to 3.14
]

ALIGN = [
    # finds the motion between two maps for `evaluate --align`; MIT, wheels for 3.10 to 3.12
    'kiss-matcher>=1.0.2; python_version < "3.13"',
]

VIEWER = [
    'rerun-sdk>=0.27',  # view, replay --view and --rrd; 0.27 is the first that places the eye
]

MESHES = [
    'trimesh>=4.6',  # OBJ, STL and glTF; MIT, Python alone, and numpy
]

NOTEBOOKS = [
    'nbformat>=5.7',  # writes the notebooks of the tutorials
    'nbclient>=0.8',  # runs them
    'ipykernel>=6.20',  # the Python that they run in
]

RUNNER = [
    'pytest>=7.4,<9',  # 9 drops what colcon test relies on
    'pytest-timeout>=2.2',  # a test that hangs names itself
    'hypothesis>=6.98',  # random sequences of adds and removes
]

# What `make test` needs. Tests of the extras below are skipped without them.
TEST = [
    *RUNNER,
    *LAS,
    *MESHES,
    'python-neo-lzf>=0.3',  # scans in compressed PCD files
    'pytest-xdist>=3.7',  # several processes: those of ROS wait, those of the others calculate
    'plyfile>=1.0.1',  # an independent reader of what we write
    'pypcd4>=1.1',  # likewise
]

# All that the tests need, with optional packages that take 1.1 GB more: `make test-extras`.
FULL = [
    *TEST,
    *FORMATS,
    *CLUSTER,
    *CLOUDS,
    *ALIGN,
    *LOOPS,  # pins numpy below 2.3; `make test` has the newest, as users have
    *VIEWER,
    *NOTEBOOKS,
    # an independent reader of trajectories, and judge of their errors; GPL-3, so it is used by the
    # tests alone, and nothing that is installed with the package imports it
    'evo>=1.28',
    'playwright>=1.40',  # opens report.html in a browser, which it does not bring
    'pandas>=2.0',  # Surfels.to_pandas
]

# Pinned, so that every machine reaches the same verdict; `make lint` keeps them in an environment
# of their own, because the types of numpy differ from one version to the next.
LINT = [
    *RUNNER,  # the tests of layers and language, which need neither ROS nor the other extras
    'ruff==0.17.6',  # style and format; its rules are in .ruff.toml
    'mypy==2.4.1',  # types; configured in setup.cfg
    'numpy==2.2.6',  # the newest for all of Python 3.10 to 3.13
]

DOCS = [
    'mkdocs>=1.6,<2',  # builds the site; its configuration is mkdocs.yml
    'mkdocs-material>=9.5',  # its theme
    'mkdocstrings[python]>=0.26',  # the reference, from docstrings
    "pymdown-extensions>=10.2,<12; python_version < '3.11'",  # mkdocstrings needs it
    'build>=1.2',  # wheel and sdist, for `make dist`
]

# colcon build --symlink-install runs a link to this file, beside which there is no README.md.
README = Path(__file__).resolve().with_name('README.md')

setup(
    name=NAME,
    version='0.1.0',
    description='Turns point clouds into a map of surfels: discs with a normal and a planarity',
    long_description=README.read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    maintainer='surfel_mapper contributors',
    maintainer_email='maintainers@surfel-mapper.example',
    url=SITE,
    project_urls={
        'Documentation': f'{SITE}/docs/',
        'Source': f'{SITE}/source/',
        'Issues': f'{SITE}/issues/',
        'Changelog': f'{SITE}/docs/changelog/',
    },
    license='Apache-2.0',
    keywords=['ROS', 'lidar', 'point cloud', 'surfel', 'mapping'],
    classifiers=[
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.10',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Scientific/Engineering',
    ],
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'ros/*.xml', 'viz/page/*']},
    install_requires=REQUIRED,
    extras_require={
        'formats': FORMATS,
        'cluster': CLUSTER,
        'las': LAS,
        'clouds': CLOUDS,
        'ouster': OUSTER,
        'align': ALIGN,
        'loops': LOOPS,
        'viewer': VIEWER,
        'meshes': MESHES,
        'notebooks': NOTEBOOKS,
        'ros': ROS,
        'test': TEST,
        'full': FULL,
        'lint': LINT,
        'docs': DOCS,
    },
    entry_points={'console_scripts': [f'surfel-mapper = {NAME}.cli.start:main']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch_configs', sorted(glob('launch_configs/*.*'))),
        (f'lib/{NAME}', ['scripts/node', 'scripts/replay']),
    ],
    zip_safe=False,  # colcon asks for it: data files are read from the disk
)
