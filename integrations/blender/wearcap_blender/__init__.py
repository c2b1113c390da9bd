"""wearcap in Blender: motions of wearcap as armatures, captures of recordings, and live motion."""

import bpy

from . import capture, live


class WearcapPreferences(bpy.types.AddonPreferences):
    bl_idname = __package__
    command: bpy.props.StringProperty(name="wearcap command", description="It, or its path", default="wearcap")

    def draw(self, context):
        self.layout.prop(self, "command")


class WearcapSettings(bpy.types.PropertyGroup):
    recording: bpy.props.StringProperty(name="Recording", description="A file or folder", subtype="FILE_PATH")
    more: bpy.props.StringProperty(name="Settings", description="More settings of wearcap capture, such as height=1.72")
    output: bpy.props.StringProperty(name="Output", description="Folder; empty: a temporary one", subtype="DIR_PATH")
    progress: bpy.props.StringProperty()
    live_host: bpy.props.StringProperty(name="Address", description="0.0.0.0: from anyone", default="127.0.0.1")
    live_port: bpy.props.IntProperty(name="Port", default=39539, min=1024, max=65535)


class WEARCAP_PT_panel(bpy.types.Panel):
    bl_label, bl_idname = "wearcap", "WEARCAP_PT_panel"
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "wearcap"

    def draw(self, context):
        layout, settings = self.layout, context.scene.wearcap
        layout.operator("wearcap.import_motion", text="Import motion.npz", icon="IMPORT")
        box = layout.box()
        box.label(text="Capture a recording")
        for name in ("recording", "more", "output"):
            box.prop(settings, name)
        running = capture.WEARCAP_OT_capture.run is not None
        box.operator("wearcap.capture_cancel" if running else "wearcap.capture", icon="CANCEL" if running else "PLAY")
        if settings.progress:
            box.label(text=settings.progress)
        box = layout.box()
        box.label(text="Live (VMC)")
        box.prop(settings, "live_host")
        box.prop(settings, "live_port")
        if live.receiver is None:
            box.operator("wearcap.live_start", icon="REC")
        else:
            box.operator("wearcap.live_stop", icon="PAUSE")
            box.label(text=f"{len(live.receiver.frames)} frames")
        box.operator("wearcap.live_bake", icon="KEYFRAME")


CLASSES = (*capture.CLASSES, *live.CLASSES, WearcapSettings, WearcapPreferences, WEARCAP_PT_panel)


def in_import_menu(menu, context):
    menu.layout.operator("wearcap.import_motion", text="wearcap motion (.npz)")


def register():
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.wearcap = bpy.props.PointerProperty(type=WearcapSettings)
    bpy.types.TOPBAR_MT_file_import.append(in_import_menu)


def unregister():
    live.stop()
    if capture.WEARCAP_OT_capture.run is not None:
        capture.WEARCAP_OT_capture.run.cancel()
    bpy.types.TOPBAR_MT_file_import.remove(in_import_menu)
    del bpy.types.Scene.wearcap
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
