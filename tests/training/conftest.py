from tests.synth.conftest import bank, bank_folder

__all__ = ["bank", "bank_folder"]
