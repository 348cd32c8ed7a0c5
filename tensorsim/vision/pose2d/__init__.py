"""Images and boxes -> COCO-17 key points."""
