"""Every mistake at the command line ends at once with a code and with words: what is wrong, and what to do."""

import re
import time
from pathlib import Path

import pytest

from cli_runs import commands_by_words, run, write_examples

# (command, exit code, words of the message); names in braces are files of `write_examples`
WRONG = [
    # no such command, option, or value
    ("calibrat x", 2, "No such command 'calibrat'. Did you mean 'calibrate', 'recalibrate'?"),
    ("--nonsense", 2, "No such option: --nonsense"),
    ("calibrate {images} -o {here}/new --nonsense", 2, "No such option: --nonsense"),
    ("calibrate {images} -o", 2, "requires an argument"),
    ("calibrate {images} {images}", 2, "unexpected extra argument"),
    ("calibrate", 2, "No recording was given."),
    ("calibrate {images} --jobs many", 2, "'--jobs'"),
    ("calibrate {images} -o {here}/new --jobs -1", 2, "Setting jobs"),
    ("calibrate {images} -o {here}/new --seed 1.5", 2, "'--seed'"),
    ("calibrate {images} -o {here}/new --start soon", 2, "'--start'"),
    ("calibrate {images} -o {here}/new --start -3", 2, "Setting start_s"),
    ("calibrate {images} -o {here}/new --start inf", 2, "Setting start_s"),
    ("calibrate {images} -o {here}/new --start nan", 2, "Setting start_s"),
    ("calibrate {images} -o {here}/new --duration 0", 2, "Setting duration_s"),
    ("calibrate {images} -o {here}/new --duration inf", 2, "Setting duration_s"),
    ("calibrate {images} -o {here}/new --precision fine", 2, "is not understood"),
    ("calibrate {images} -o {here}/new --precision 5", 2, "is not understood"),
    ("calibrate {images} -o {here}/new --precision 0mm", 2, "is not understood"),
    ("calibrate {images} -o {here}/new --precision 5mm,2cm", 2, "is not understood"),
    ("calibrate {images} -o {here}/new --set precision=soon", 2, "is not understood"),
    ("calibrate {images} -o {here}/new --budget 0", 2, "Setting budget_s"),
    ("calibrate {images} -o {here}/new --budget inf", 2, "Setting budget_s"),
    ("calibrate {images} -o {here}/new --budget soon", 2, "'--budget'"),
    ("calibrate {images} -o {here}/new --all --budget 60", 2, "Give one of them."),
    ("calibrate {images} -o {here}/new --all --precision 5mm", 2, "Give one of them."),
    ("calibrate {images} -o {here}/new --set speed=3", 2, "Setting speed"),
    ("calibrate {images} -o {here}/new --set speed", 2, "is not KEY=VALUE"),
    ("calibrate {images} -o {here}/new --set seed=[1", 2, "the value is not YAML"),
    ("calibrate {images} -o {here}/new --config {nowhere}", 1, "There is no file"),
    ("calibrate {images} -o {here}/new --config {list}", 1, "holds no mapping"),
    ("calibrate {images} -o {here}/new --config {broken}", 1, "cannot be read as YAML"),
    (
        "calibrate {images} -o {here}/new --cameras fornt --set min_duration_s=1",
        2,
        "No camera 'fornt' in images.",
    ),
    # recordings
    ("calibrate {nowhere}", 1, "There is no file or folder"),
    ("calibrate {here}/imagse -o {here}/new", 1, "images meant?"),
    ("calibrate {text} -o {here}/new", 1, "is not a recording that rigwake knows."),
    ("calibrate {empty} -o {here}/new", 1, "is not a recording that rigwake knows."),
    ("calibrate {nmea} -o {here}/new", 1, "has no cameras."),
    ("calibrate {images} -o {here}/new", 3, "s of images are to be used."),
    ("calibrate {unlensed} -o {here}/new --set min_duration_s=1", 1, "No camera has intrinsics."),
    # where the result goes
    ("calibrate {images} -o {text}", 2, "is a file, a folder is wanted."),
    ("calibrate {images} -o {text}/inside", 2, "is a file, not a folder"),
    ("calibrate {images} -o {images}/OUT", 2, "lies inside of"),
    ("calibrate {images} -o {images}", 2, "lies inside of"),
    ("calibrate {images} -o ''", 2, "-o names no folder."),
    ("calibrate {images} -o {here}/" + "x" * 250, 2, "is no possible path."),
    ("calibrate {images} -o /proc/nothing/here", 2, "cannot be written"),
    ("calibrate {images} -o {taken}", 2, "holds the result of another run."),
    ("calibrate {images} -o {taken} --force --resume", 2, "Give one of them."),
    ("calibrate {images} -o {here}/new --json {empty}", 2, "is a folder, a file is wanted."),
    ("calibrate {images} -o {here}/new --json {text}/x.json", 2, "is a file, not a folder"),
    # what is known beforehand
    ("calibrate {images} -o {here}/new --reference mast --set min_duration_s=1", 2, "'mast' takes no part."),
    ("calibrate {images} -o {here}/new --reference imu --set min_duration_s=1", 2, "'imu' takes no part."),
    ("calibrate {images} -o {here}/new --prior {nowhere}", 1, "There is no file"),
    ("calibrate {images} -o {here}/new --prior {list}", 1, "holds no mapping"),
    ("calibrate {images} -o {here}/new --prior {calibration}", 1, "unknown keys"),
    (
        "calibrate {images} -o {here}/new --prior {prior} --set min_duration_s=1",
        2,
        "'lefft' that takes no part",
    ),
    ("calibrate {images} -o {here}/new --trajectories {nowhere}", 1, "There is no file or folder"),
    ("calibrate {images} -o {here}/new --trajectories {text} --set min_duration_s=1", 2, "is no folder."),
    (
        "calibrate {images} -o {here}/new --trajectories {empty} --set min_duration_s=1",
        1,
        "front.tum, left.tum",
    ),
    ("calibrate {images} -o {here}/new --set min_duration_s=1 --set line_delay_s.frnt=1e-5", 2, "'frnt'"),
    # topics
    ("inspect {images} --topic front", 2, "is not NAME=TOPIC."),
    ("inspect {images} --topic radar=/x", 2, "does not say which sensor"),
    ("inspect {images} --topics {nowhere}", 1, "There is no file"),
    ("inspect {images} --topics {list}", 1, "is not a YAML mapping."),
    ("inspect {nowhere}", 1, "There is no file or folder"),
    ("inspect /dev/zero", 1, "is neither a file nor a folder."),
    ("inspect {here}/" + "y" * 300, 1, "There is no file or folder"),
    ("handeye {rig_tum} /dev/zero", 1, "is neither a file nor a folder."),
    ("inspect ''", 2, "An empty name is no path."),
    ("inspect", 2, "Missing argument"),
    ("inspect {images} --html {empty}", 2, "is a folder, a file is wanted."),
    # odometry
    ("odometry {images}", 2, "Missing option"),
    ("odometry {images} -o {here}/new --camera mast", 2, "No camera 'mast'"),
    ("odometry {images} -o {here}/new --front-end surf", 2, "Choose from klt"),
    ("odometry {images} -o {here}/new --method best", 2, "Choose from adjusted"),
    ("odometry {images} -o {here}/new --mask {nowhere}", 1, "There is no file"),
    ("odometry {images} -o {here}/new --jobs -2", 2, "'--jobs'"),
    ("odometry {images} -o {images}/new", 2, "lies inside of"),
    ("odometry {nmea} -o {here}/new", 1, "has no cameras."),
    # handeye
    ("handeye {rig_tum}", 2, "Missing argument"),
    ("handeye {rig_tum} {nowhere}", 1, "There is no file"),
    ("handeye {rig_tum} {text}", 1, "text.txt"),
    ("handeye {rig_tum} {port_tum} --noise loud", 2, "Choose from auto"),
    ("handeye {rig_tum} {port_tum} --method best", 2, "Choose from ml"),
    ("handeye {rig_tum} {port_tum} -o {empty}", 2, "is a folder, a file is wanted."),
    # intrinsics
    ("intrinsics {images}", 2, "Images need a board."),
    ("intrinsics {nowhere} --board chessboard:9x6:0.03", 1, "There is no file"),
    ("intrinsics {images} --board chessboard", 2, "board"),
    ("intrinsics {images} --board triangle:3x3:1", 2, "board"),
    ("intrinsics {images} --board chessboard:9x6:0.03 --model fisheye", 2, "Choose from pinhole"),
    ("intrinsics {images} --board chessboard:9x6:0.03 --fov 400", 2, "a number above 0 and below 360"),
    ("intrinsics {images} --camera all", 2, "Images need a board."),
    ("intrinsics {images} --camera aft --board chessboard:9x6:0.03", 2, "aft"),
    (
        "intrinsics {images} {images} --camera all --board chessboard:9x6:0.03",
        2,
        "--camera reads one recording.",
    ),
    ("intrinsics {corners}", 2, "needs the image size."),
    ("intrinsics {corners} --image-size big", 2, "is not WIDTHxHEIGHT."),
    ("intrinsics {corners} --image-size 0x0", 2, "is not WIDTHxHEIGHT."),
    # calibrations
    ("evaluate {calibration} --truth {nowhere}", 1, "There is no file"),
    ("evaluate {calibration}", 2, "Missing option"),
    ("evaluate {calibration} --truth {calibration} --gauge loose", 2, "Choose from reference, align"),
    ("evaluate {nothing} --truth {calibration}", 1, "nothing.yaml"),
    ("evaluate {calibration} --truth {list}", 1, "list.yaml"),
    ("evaluate {rig_tum} --truth {rig_tum} --alignment loose", 2, "Choose from auto, se3, sim3, none"),
    ("evaluate {rig_tum} --truth {rig_tum} --max-difference 0", 2, "a number above 0"),
    ("evaluate {rig_tum} --truth {calibration}", 1, "calibration.yaml"),
    ("evaluate {text} --truth {rig_tum}", 1, "text.txt"),
    ("evaluate {calibration} --truth {calibration} --html {here}/x.html", 2, "--html is for trajectories."),
    ("diff {calibration}", 2, "Missing argument"),
    ("diff {calibration} {nowhere}", 1, "There is no file"),
    ("diff {calibration} {calibration} --range nan", 2, "a number above 0"),
    ("diff {calibration} {calibration} --range -5", 2, "a number above 0"),
    ("diff {calibration} {calibration} --range inf", 2, "a number above 0"),
    ("export {calibration}", 2, "Missing option '--to'"),
    ("export {calibration} --to xml", 2, "Choose from kalibr"),
    ("export {calibration} --to kalibr -o {empty}", 1, "it is a folder, where a file is wanted"),
    ("export {calibration} --to kalibr -o {here}/c.yaml --max-fit-error nan", 2, "a number above 0"),
    ("export {open} --to kalibr -o {here}/c.yaml", 3, "unobservable"),
    ("export {broken} --to kalibr", 1, "broken.yaml"),
    ("export {calibration} --to basalt --imu {nowhere}", 1, "There is no file"),
    ("report {nowhere}", 1, "There is no file or folder"),
    ("report {empty}", 1, "holds no calibration.yaml."),
    ("report {taken} --figures {here}/figures --figure-format gif", 2, "Choose from png, svg"),
    ("odometry {images} -o {here}/new --stereo front", 2, "needs two cameras"),
    (
        "odometry {images} -o {here}/new --stereo front,fornt --rig {calibration}",
        2,
        "No camera 'fornt' in images.",
    ),
    ("odometry {images} -o {here}/new --stereo front,left --rig {nowhere}", 1, "There is no file"),
    # the surround view
    ("surround {calibration}", 2, "Nothing to show."),
    ("surround {calibration} {images}", 2, "Nothing to write to."),
    ("surround {calibration} {nowhere} -o {here}/s.png", 1, "There is no file"),
    ("surround {calibration} {images} -o {here}/s.png --view sideways", 2, "Choose from panorama"),
    ("surround {calibration} {images} -o {here}/s.gif", 2, "what should .gif be?"),
    ("surround {calibration} {images} -o {text}/s.png", 2, "is a file, not a folder"),
    ("surround {calibration} {images} -o {here}/s.png --size big", 2, "is not two numbers."),
    ("surround {calibration} {images} --serve 99999", 2, "is no port to serve on."),
    ("surround {calibration} {images} --serve --from front=rtsp://x", 2, "contradict each other."),
    # has a camera moved? and the logbook
    ("monitor {calibration}", 2, "Missing argument"),
    ("monitor {calibration} {nowhere}", 1, "There is no file"),
    ("monitor {calibration} {images} -o {text}", 2, "is a file, a folder is wanted."),
    ("monitor {calibration} {images} --log {empty}", 2, "is a folder, a file is wanted."),
    ("monitor {nothing} {images}", 1, "nothing.yaml"),
    ("recalibrate {calibration} {images}", 2, "Missing option"),
    ("recalibrate {calibration} {nowhere} -o {here}/n.yaml", 1, "There is no file"),
    ("recalibrate {calibration} {images} -o {calibration}", 2, "is already there."),
    ("recalibrate {calibration} {images} -o {empty}", 2, "is a folder, a file is wanted."),
    ("log dance {here}/vessel.db", 2, "Choose from add, list"),
    ("log list {here}/vessel.db", 1, "There is no file"),
    ("log add {here}/vessel.db", 2, "takes 1 argument"),
    ("log add {here}/vessel.db {nowhere}", 1, "There is no file"),
    ("log list {text}", 1, "text.txt"),
    ("log add {here}/vessel.db {calibration} --from soon", 2, "is no time."),
    # simulate
    ("simulate demo", 2, "-o names the recording."),
    ("simulate nonsense -o {here}/new.bag", 2, "neither a file nor a preset"),
    ("simulate demo -o {text}", 2, "is already there."),
    ("simulate demo -o {here}/new.mp4", 2, "no recording has the suffix .mp4"),
    ("simulate demo -o {text}/new.bag", 2, "is a file, not a folder"),
    ("simulate demo -o {here}/new.bag --duration nan", 2, "a number above 0"),
    ("simulate demo -o {here}/new.bag --duration -1", 2, "a number above 0"),
    ("simulate demo -o {here}/new.bag --jobs 0", 2, "'--jobs'"),
    ("simulate {list} -o {here}/new.bag", 2, "list.yaml"),
    # fleet and ros
    ("fleet calibrat {images}", 2, "No such command 'calibrat'"),
    ("fleet calibrate", 2, "Missing argument"),
    ("fleet calibrate {images}", 2, "Missing option"),
    ("fleet calibrate {nowhere} -o {here}/new", 1, "There is no file or folder"),
    ("fleet calibrate {empty} -o {here}/new", 2, "No recording is in"),
    ("fleet calibrate {here}/none*.bag -o {here}/new", 2, "No recording is in"),
    ("fleet calibrate {images} -o {text}", 2, "is a file, a folder is wanted."),
    ("fleet calibrate {images} -o {here}/new --shard 3", 2, "is no part."),
    ("fleet calibrate {images} -o {here}/new --shard 0/3", 2, "is no part."),
    ("fleet calibrate {images} -o {here}/new --shard 4/3", 2, "is no part."),
    ("fleet calibrate {images} -o {here}/new --scheduler here", 2, "is no address."),
    ("fleet calibrate {images} -o {here}/new --scheduler local:0", 2, "is no address."),
    ("fleet calibrate {images} -o {here}/new --timeout 0", 2, "a number above 0"),
    ("fleet calibrate {images} -o {here}/new --timeout nan", 2, "a number above 0"),
    ("fleet calibrate {images} -o {here}/new --memory -1", 2, "a number above 0"),
    ("fleet calibrate {images} -o {here}/new --retries -1", 2, "'--retries'"),
    ("fleet calibrate {images} -o {here}/new --jobs -1", 2, "'--jobs'"),
    ("fleet calibrate {images} -o {here}/new --config {nowhere}", 1, "There is no file"),
    ("fleet calibrate {images} -o {here}/new --set speed=3", 2, "Setting speed"),
    ("fleet calibrate {images} -o {here}/new --topic radar=/x", 2, "does not say which sensor"),
    ("fleet monitor {images} -o {here}/new", 2, "Missing option '--calibration'"),
    ("fleet monitor {images} -o {here}/new --calibration {nowhere}", 1, "There is no file"),
    ("fleet monitor {images} -o {here}/new --calibration {broken}", 1, "broken.yaml"),
    ("fleet monitor {images} -o {here}/new --calibration {empty}", 2, "No calibration of the vessel"),
    ("calibrate {images} -o {here}/new --scheduler here", 2, "is no address."),
    ("ros node loud", 2, "is no remapping."),
    ("ros node -o {text}", 2, "is a file, a folder is wanted."),
    ("ros node --calibration {nowhere}", 1, "There is no file"),
    ("ros node --child-frame cam -o {here}/new", 2, "names all cameras alike."),
    ("ros node --monitor-seconds -1 -o {here}/new", 2, "a number above"),
    ("ros node --surround-hz -1 -o {here}/new", 2, "a number above"),
    ("ros node --ros 3 -o {here}/new", 2, "is no version of ROS."),
    ("ros node --ros 2 -o {here}/new", 1, "ROS 2 is not usable here"),
    ("demo -o {text}", 2, "is a file, a folder is wanted."),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("wrong")
    return write_examples(folder) | {"nowhere": folder / "no" / "where"}


@pytest.fixture(scope="module")
def options() -> dict[str, set[str]]:
    """All options of every verb."""
    return {
        verb: {name for p in command.params for name in (*p.opts, *p.secondary_opts)} | {"--help", "-h"}
        for verb, command in commands_by_words().items()
    }


def words_of_command(text: str, files: dict[str, Path]) -> list[str]:
    return ["" if word == "''" else word.format(**files) for word in text.split(" ")]


def test_the_table_is_long_enough() -> None:
    assert len(WRONG) >= 100
    assert len({command for command, _, _ in WRONG}) == len(WRONG)


@pytest.mark.parametrize(("command", "code", "said"), WRONG, ids=[command[:70] for command, _, _ in WRONG])
def test_wrong_usage(
    command: str, code: int, said: str, files: dict[str, Path], options: dict[str, set[str]]
) -> None:
    before = sorted(files["here"].rglob("*"))
    started = time.process_time()
    ended = run(*words_of_command(command, files))
    assert ended.code == code, ended.words
    assert "".join(said.split()) in "".join(ended.words.split()), ended.words  # lines may break within a word
    assert "Traceback" not in ended.err
    assert time.process_time() - started < 5
    assert sorted(files["here"].rglob("*")) == before, "something was written"
    verb = command.split(" ")[0]
    named = set(re.findall(r"(?<![\w-])--?[a-z][a-z-]+", ended.words.partition("→")[2]))
    elsewhere = {option for known in options.values() for option in known}
    assert named <= (elsewhere if verb not in options else options[verb] | elsewhere), named


def test_a_link_in_place_of_the_folder_is_followed(files: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(files["taken"])
    ended = run("calibrate", files["images"], "-o", tmp_path / "link")
    assert ended.code == 2
    assert "holds the result of another run." in ended.words
