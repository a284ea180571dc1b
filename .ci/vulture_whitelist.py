"""Names that nothing in the package uses, each with the reason why it stays; read by vulture, never run."""

# public API, used from outside
read_kitti  # users with trajectories in KITTI's format
write_kitti  # the same, the other way
of_classes  # on Instances, for authors of filters and segmenters
# on SlamEnv, for agents: the action that changes nothing (docs/reference/environments.md)
neutral_action
clone_state  # on SlamEnv, for agents: a copy of the episode (docs/reference/environments.md)
restore_state  # the same: back to it
rtf  # on Outcome, for objectives of one's own (docs/how-to/study.md)

modules_of_run  # runs.own_code: tests and a benchmark ask which modules count
__class__  # runs.process.announcing: Python reads it
inode  # runs.process.collector.Stamp: stamps are compared as a whole
build_selfie  # segmentation.build_segmenter names it by its path
compile_kernels  # cli.demo: processes of the tests' conftest call it
exact_depth  # on rendered sequences: depth without the sensor's noise, to judge measured depth by

# flow.moth_flame: the equations as they read, beside the kernel that a test compares with them
moth_positions
opposites  # flow.moth_flame: the same
# features.fast: the instructions in plain code, which a test compares them with
plain_corner_scores
plain_maxima
# core.simd and flow: likewise
plain_total
plain_average
plain_average_of_pairs
plain_derivatives
plain_store_normalised
plain_store_offsets
plain_square
plain_sample
plain_descriptor_sum

# called by name: specs name their factories as "module:name"
OrbExtractor  # features.registry
build_daisy  # flow.daisy
build_mask_stage  # trackers.systems.composition
score_job  # runs.scoring
build_recorded  # segmentation.registry
build_oracle  # segmentation.registry
build_embedded  # segmentation.registry
build_coco  # segmentation.registry
build_weights  # segmentation.registry
build_detect_slam  # trackers.systems
open_rendered  # sequences.catalogue
run_loop  # runs.process.child.WORK
BatchTracker  # trackers.adapters.specs
ConstantVelocity  # trackers.adapters.specs
NeverMove  # trackers.adapters.specs
Open3dOdometry  # trackers.adapters.specs
OpenCvOdometry  # trackers.adapters.specs
unavailable  # trackers.adapters.specs: whether it can be had
OrbSlam3  # trackers.adapters.specs
OrbSlam3Monocular  # trackers.adapters.specs
Svo  # trackers.adapters.specs
Replay  # trackers.adapters.specs
BoxDepthFilter  # trackers.systems: a system names its rules
BoxEpipolarFilter  # trackers.systems: a system names its rules
ClassRuleFilter  # trackers.systems: a system names its rules
CorrelationFilter  # trackers.systems: a system names its rules
DepthBlockFilter  # trackers.systems: a system names its rules
DepthRansacFilter  # trackers.systems: a system names its rules
EpipolarFilter  # trackers.systems: a system names its rules
FreeSpaceFilter  # trackers.systems: a system names its rules
MovingVoteFilter  # trackers.systems: a system names its rules
MultiViewFilter  # trackers.systems: a system names its rules
ReseedingFilter  # trackers.systems: a system names its rules
ResidualFilter  # trackers.systems: a system names its rules
RigidMotionFilter  # trackers.systems: a system names its rules
SemanticFilter  # trackers.systems: a system names its rules
TemplateFilter  # trackers.systems: a system names its rules
box_depth  # trackers.systems: a system names the settings of its rules
depth_blocks  # trackers.systems: a system names the settings of its rules
depth_ransac  # trackers.systems: a system names the settings of its rules
free_space  # trackers.systems: a system names the settings of its rules
moving_vote  # trackers.systems: a system names the settings of its rules
multiview  # trackers.systems: a system names the settings of its rules
reseeding  # trackers.systems: a system names the settings of its rules

# called by a library
as_json  # options of verbs: the callback of --json switches the output
help_all  # the same: the callback of --help-all writes the help
__dir__  # the interpreter: dir(dynslam_bench)
__getattr__  # Python asks it for names of a package that are loaded late
action_space  # gymnasium.Env
observation_space  # gymnasium.Env
infer_relative_search_space  # optuna.samplers.BaseSampler
sample_relative  # optuna.samplers.BaseSampler
default_factory  # pydantic.fields.FieldInfo
writeable  # numpy.ndarray.flags
_SimdModel  # numba registers it by its decorator
compile_extra  # numba.core.compiler.CompilerBase
keywords  # numba: a signature of a typing template
muted_rows  # reports/html/templates/report.html.j2
mtime_ns  # core.fingerprint: part of the key of the cached function
modified_ns  # trackers.adapters.orbslam3: part of the key of the cached function

# fields of records and results: written for those who read the files
descriptor_bytes  # FeatureSpec
median_dt_s  # evaluation
translation_m  # evaluation: the alignment
n_ground_truth  # evaluation
hole_at_s  # evaluation
n_initialising  # run.json
n_dropped  # run.json
finalize_s  # run.json
peak_gpu_memory_mb  # run.json
trained_on  # a checkpoint's record
median_ms  # segmenter evaluate
mean_ap  # segmenter evaluate
mean_iou  # segmenter evaluate
tracker_provenance  # provenance.json of an export
checked  # record of a fetched sequence
improves  # a study's summary
by_category  # a row of the board, read by its template
cost_after  # BundleResult, the same
frame_error_trans_m  # a column of frames.csv
frame_error_rot_deg  # a column of frames.csv
pose_error_trans_m  # a column of frames.csv
pose_error_rot_deg  # a column of frames.csv
reward_m  # a column of frames.csv
_.append_logs  # Optuna calls it: a backend of its journal
_.tempdir  # tempfile reads it: where a run's temporary files go
_.row_poses  # rendered sequences: the exact pose of every row
pytest_addoption  # pytest calls it
pytest_collection_modifyitems  # pytest calls it
dynslam_gate  # a fixture of pytest
reran_baseline  # a field of gate.json
entered  # a field of an entry of a round
_.runtest  # pytest calls it
_.reportinfo  # pytest calls it

dynslam_gate  # gate.pytest_plugin: pytest calls it
reran_baseline  # gate.result: for those who read the file
describe_batch  # trackers.adapters: specs name them as "module:name"
describe_served
build_described
