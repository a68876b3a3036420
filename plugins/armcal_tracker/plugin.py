"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_measurements(register: Register) -> None:
    register("tip_position", "armcal_tracker.position:TipPosition", "position of a target on the tool")
    register("tip_pose", "armcal_tracker.position:TipPose", "position and orientation of a body on the tool")


@hookimpl
def armcal_register_readers(register: Register) -> None:
    register("csv", "armcal_tracker.csv_reader:CsvReader", "columns by name with their unit as suffix")
    register("pose_csv", "armcal_tracker.csv_reader:PoseCsvReader", "as csv, with orientations in it")
    register("pose_pairs", "armcal_tracker.pose_pairs:PosePairsReader", "samples of moveit_calibration, easy_handeye2")


@hookimpl
def armcal_register_trackers(register: Register) -> None:
    register("dtrack", "armcal_tracker.trackers:DTrackTracker", "DTrack's ASCII output over UDP")
    register("json_lines", "armcal_tracker.trackers:JsonLinesTracker", "a JSON object a line: UDP, or a growing file")
