"""Recognition people can rely on: false alarms, many instances, occlusion, likenesses, pose, a library, twins."""
