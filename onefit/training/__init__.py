"""Training: garments and motions go in, a network's weights come out."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "data": ["TrainingData"],
        "loop": ["OneFitTraining", "data_of", "train"],
        "settings": ["OBJECTIVES", "PRESETS", "STANDARD", "Settings"],
    },
)
