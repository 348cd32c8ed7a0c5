"""Images and boxes -> COCO-17 keypoints."""
