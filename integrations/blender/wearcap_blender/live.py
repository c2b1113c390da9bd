"""Live motion by the VMC protocol: a UDP port is read by a timer, an armature follows, and what came is baked into keyframes."""

import socket
import time

import bpy

from . import armature, osc

NAME = "wearcap live"
TICK_S = 1 / 60
MAX_DATAGRAMS = 200
"""Datagrams that are read at one tick; what comes faster waits in the system's buffer, which drops it."""
MAX_FRAMES = 120 * 600
"""Most frames that are kept for baking: ten minutes at 120 Hz."""


class Receiver:
    """One open port, and the frames that have come to it."""

    def __init__(self, host, port):
        """Raises OSError for an address at which nothing can be received."""
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.bind((host, port))
        except OSError:
            self.socket.close()
            raise
        self.socket.setblocking(False)
        self.port = self.socket.getsockname()[1]
        self.frames, self.reader, self.object_name = [], osc.Frames(), ""

    def read(self):
        """Take what has come; returns whether there is a new frame."""
        new = False
        for _ in range(MAX_DATAGRAMS):
            try:
                data = self.socket.recv(65536)
            except (BlockingIOError, InterruptedError):
                break
            except OSError:  # Windows reports here that an earlier packet of ours was not taken
                continue
            frame = self.reader.take(data, time.monotonic())
            if frame is None:
                continue
            new = True
            if self.frames and (frame[0] < self.frames[-1][0] or len(frame[1]) > len(self.frames[0][1])):
                self.frames.clear()  # the sender has begun anew, or sends its bones in several datagrams
            if self.frames and (frame[0] == self.frames[-1][0] or len(self.frames) >= MAX_FRAMES):
                self.frames[-1] = frame
            else:
                self.frames.append(frame)
        return new

    def tick(self):
        """Let the armature follow the newest frame."""
        if self.read():
            motion = osc.motion_of([self.frames[0], self.frames[-1]])
            shown = bpy.data.objects.get(self.object_name)
            if shown is None or set(shown.data.bones.keys()) != set(motion.names):
                shown = armature.build(bpy.context, motion, NAME)
                self.object_name = shown.name
            armature.show(shown, motion)


receiver, taken = None, []
"""The open receiver, and the frames of the last one."""


def tick():
    """Blender's timer, which ends with the receiver; in other modes the armature stands still."""
    if receiver is not None and bpy.context.mode in ("OBJECT", "POSE"):
        receiver.tick()
    return None if receiver is None else TICK_S


def start(host, port):
    """Receive at an address. Raises OSError where that is impossible."""
    global receiver
    stop()
    receiver = Receiver(host, port)
    bpy.app.timers.register(tick, first_interval=TICK_S)
    return receiver


def stop():
    global receiver, taken
    if receiver is not None:
        receiver.socket.close()
        taken = receiver.frames
    receiver = None


class WEARCAP_OT_live_start(bpy.types.Operator):
    bl_idname, bl_label = "wearcap.live_start", "Receive"
    bl_description = "Receive live motion by the VMC protocol: wearcap live … to=vmc://127.0.0.1:PORT"

    def execute(self, context):
        settings = context.scene.wearcap
        try:
            start(settings.live_host, settings.live_port)
        except OSError as error:
            self.report({"ERROR"}, f"Nothing can be received at {settings.live_host}:{settings.live_port} ({error})")
            return {"CANCELLED"}
        return {"FINISHED"}


class WEARCAP_OT_live_stop(bpy.types.Operator):
    bl_idname, bl_label, bl_description = "wearcap.live_stop", "Stop", "Stop receiving; what came can still be baked"

    def execute(self, context):
        stop()
        return {"FINISHED"}


class WEARCAP_OT_live_bake(bpy.types.Operator):
    bl_idname, bl_label = "wearcap.live_bake", "Bake"
    bl_description, bl_options = "Make keyframes of all that was received", {"REGISTER", "UNDO"}

    def execute(self, context):
        frames = taken if receiver is None else receiver.frames
        if len(frames) < 2:
            self.report({"ERROR"}, "Nothing was received that could be baked")
            return {"CANCELLED"}
        armature.add(context, osc.motion_of(frames), "wearcap take")
        return {"FINISHED"}


CLASSES = (WEARCAP_OT_live_start, WEARCAP_OT_live_stop, WEARCAP_OT_live_bake)
