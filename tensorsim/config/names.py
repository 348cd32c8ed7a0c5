"""Names of joints, keypoints and activities, in their order."""

#: The 14 joints of the radar body, in the OpenPose order whose indices the paper uses.
JOINTS = (
    "head",
    "neck",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "right_hip",
    "right_knee",
    "right_ankle",
    "left_hip",
    "left_knee",
    "left_ankle",
)

#: Arms and legs by the indices of their joints, upper segment first.
LIMBS = ((2, 3), (3, 4), (5, 6), (6, 7), (8, 9), (9, 10), (11, 12), (12, 13))

#: Radar cross section of each joint in m^2 (illegible in the panel for the legs: hip 0.1, knee 0.4, ankle 0.3).
JOINT_RCS_M2 = (0.5, 1.0, 0.1, 0.3, 0.2, 0.1, 0.3, 0.2, 0.1, 0.4, 0.3, 0.1, 0.4, 0.3)

#: The 17 keypoints of COCO, in the order of its annotations.
COCO_KEYPOINTS = (
    "nose",
    "left_eye",
    "right_eye",
    "left_ear",
    "right_ear",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
)

#: The 12 activity classes of the paper.
ACTIVITIES = (
    "S1 Empty",
    "S2 Punching",
    "S3 Kicking",
    "S4 Grabbing",
    "S5 Sitting Down",
    "S6 Standing Up",
    "S7 Rotating",
    "S8 Walking",
    "S9 Sitting to Walking",
    "S10 Walking to Sitting",
    "S11 Falling to Walking",
    "S12 Walking to Falling",
)
