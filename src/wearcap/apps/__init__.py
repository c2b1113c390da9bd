"""Programs for a person, each a folder that only the verb of its name starts: doctor, viewer, annotate, scene_editor, live."""
