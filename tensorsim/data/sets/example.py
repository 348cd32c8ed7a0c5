"""Commented recipes that run as they are: a small one, and one for training a classifier."""

EXAMPLE = """\
# A recipe of a labelled data set. Build it: tensorsim dataset build RECIPE.yaml --out DIR --workers 2
# What is not named keeps its default; the recipe.yaml in the folder of a data set names everything.
name: example
seed: 0              # everything that is random follows from it
duration_s: 4.0      # length of every sample

sources:             # people and labels; several sources may stand here
  - kind: generated  # or: films, keypoints, motion (a folder with a folder per class), table, ntu, kinetics, ...
    classes: [walking, sitting down]
    people: 4        # everybody does every activity
  # - kind: films
  #   path: my_films # my_films/CLASS/*.mp4

variations:          # of every clip; ranges are drawn uniformly
  count: 1           # samples of each clip
  height_m: [1.55, 1.90]
  distance_m: [2.0, 5.0]
  heading_deg: [-30.0, 30.0]
  mirror: 0.5        # probability
  speed: [0.9, 1.1]
  snr_db: [10.0, 50.0]
  # adc_bits: [8, 12]                     # also phase_noise_dbc_hz, iq_imbalance_db, dc_offset_db, ... of receivers
  # denoisers: [none, perona-malik]       # one of them for each sample; also dncnn, or a file of its weights

radars:              # all see the same motion
  - name: front
    preset: through-wall  # or free-space, ti-iwr6843, ... or a YAML file of a radar
  # - name: side     # a second one, to the left, that looks along +x
  #   preset: free-space
  #   x_m: -3.5
  #   y_m: 3.5
  #   yaw_deg: -90.0

outputs:
  kinds: [doppler_time]   # also range_time, range_time_mti, ridges, picture, profiles, if_signal, joints, ...
  dtype: uint8            # or float16, in dB
  range_db: 60.0
  rate_hz: 32.0           # columns per second at most; an overlap of 0.5 gives about 20

split:
  by: person              # nobody is in two parts
  shares: [0.5, 0.25, 0.25]

storage:
  format: webdataset      # or hdf5, mat, png
  shard_samples: 4
"""

LARGE_EXAMPLE = """\
# 1200 samples of the 12 activities, each seen by three radars through walls at right angles and in front.
# Build it: tensorsim dataset build RECIPE.yaml --out DIR --workers 2
# Train on it: tensorsim train classifier --data DIR --network spgnet --epochs 20 --out OUT
name: three-radars
seed: 0
duration_s: 4.0
sources:
  - kind: generated
    people: 100        # everybody does every activity
variations:
  snr_db: [10.0, 50.0]
radars:
  - {name: front, preset: through-wall}
  - {name: left, preset: through-wall, x_m: -4.0, y_m: 4.0, yaw_deg: -90.0}
  - {name: right, preset: through-wall, x_m: 4.0, y_m: 4.0, yaw_deg: 90.0}
outputs:
  kinds: [doppler_time]
  size: [128, 128]     # rows, columns
"""
