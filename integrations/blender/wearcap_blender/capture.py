"""Import of motion.npz, and the installed `wearcap` command run from Blender; nothing of wearcap runs inside Blender."""

import os
import shlex
import signal
import subprocess
import tempfile
import threading
from collections import deque
from pathlib import Path

import bpy
from bpy_extras.io_utils import ImportHelper

from . import armature
from .motion_file import read_motion

POLL_S, MAX_LINE = 0.2, 400


def import_motion(context, path):
    """A new armature with the motion of a file. Raises ValueError and OSError as `read_motion` does."""
    name = Path(path).parent.name if Path(path).stem == "motion" else Path(path).stem
    return armature.add(context, read_motion(path), name or "motion")


class WEARCAP_OT_import(bpy.types.Operator, ImportHelper):
    bl_idname, bl_label = "wearcap.import_motion", "Import wearcap motion"
    bl_description, bl_options = "Import a motion.npz of wearcap", {"REGISTER", "UNDO"}
    filename_ext = ".npz"
    filter_glob: bpy.props.StringProperty(default="*.npz", options={"HIDDEN"})

    def execute(self, context):
        try:
            import_motion(context, self.filepath)
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, f"{self.filepath}: {error}")
            return {"CANCELLED"}
        return {"FINISHED"}


class Run:
    """One run of `wearcap capture` in a process group of its own."""

    def __init__(self, command, recording, output, more=""):
        """Raises OSError where the command cannot be started, and ValueError for settings with an open quote."""
        words = shlex.split(command, posix=os.name == "posix") or ["wearcap"]
        self.output = Path(output)
        self.lines = deque(maxlen=200)
        self.canceled = False
        given = [f"recording={recording}", f"output={self.output}", "video=false", *shlex.split(more)]
        self.process = subprocess.Popen(
            [*words, "capture", *map(_quoted, given)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=os.name == "posix",
        )
        self.reading = threading.Thread(target=self._read, daemon=True)
        self.reading.start()

    def _read(self):
        while line := self.process.stdout.readline(MAX_LINE):
            if text := line.decode("utf-8", "replace").strip():
                self.lines.append(text)

    def poll(self):
        """None while it runs, else whether it succeeded."""
        if (code := self.process.poll()) is None:
            return None
        self.reading.join(1.0)
        return code == 0 and (self.output / "motion.npz").is_file()

    def cancel(self):
        """End the command, and what it has started."""
        self.canceled = True
        if self.process.poll() is None and os.name == "posix":
            os.killpg(self.process.pid, signal.SIGTERM)
        elif self.process.poll() is None:
            self.process.terminate()


def _quoted(setting):
    """A setting whose value Hydra takes as it is: paths may have spaces, commas and brackets."""
    key, _, value = setting.partition("=")
    plain = all(letter.isalnum() or letter in "_-./:" for letter in value)
    if plain or value[:1] in "[{'\"":
        return setting
    return f"{key}='" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"


class WEARCAP_OT_capture(bpy.types.Operator):
    bl_idname, bl_label = "wearcap.capture", "Capture"
    bl_description = "Capture a recording with the wearcap command, and import its motion"
    run = None

    def execute(self, context):
        settings = context.scene.wearcap
        recording = bpy.path.abspath(settings.recording)
        output = bpy.path.abspath(settings.output) if settings.output else tempfile.mkdtemp(prefix="wearcap-")
        addon = context.preferences.addons.get(__package__)
        command = addon.preferences.command if addon else "wearcap"
        try:
            WEARCAP_OT_capture.run = Run(command, recording, output, settings.more)
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, f"The wearcap command does not start ({error}): see the add-on's preferences")
            return {"CANCELLED"}
        self.timer = context.window_manager.event_timer_add(POLL_S, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        run, settings = WEARCAP_OT_capture.run, context.scene.wearcap
        done = run.poll()
        settings.progress = run.lines[-1] if run.lines else "starting"
        for area in context.screen.areas if context.screen else ():
            area.tag_redraw()
        if done is None:
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self.timer)
        WEARCAP_OT_capture.run = None
        if not done:
            why = "canceled" if run.canceled else " ".join(list(run.lines)[-3:]) or "wearcap gave no motion"
            self.report({"INFO" if run.canceled else "ERROR"}, why)
            return {"CANCELLED"}
        try:
            import_motion(context, run.output / "motion.npz")
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
        return {"FINISHED"}


class WEARCAP_OT_capture_cancel(bpy.types.Operator):
    bl_idname, bl_label, bl_description = "wearcap.capture_cancel", "Cancel", "End the running capture"

    def execute(self, context):
        if WEARCAP_OT_capture.run is not None:
            WEARCAP_OT_capture.run.cancel()
        return {"FINISHED"}


CLASSES = (WEARCAP_OT_import, WEARCAP_OT_capture, WEARCAP_OT_capture_cancel)
